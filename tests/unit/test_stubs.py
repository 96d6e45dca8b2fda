"""`_core.pyi` names what the extension has, and its arguments as the extension takes them."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import pssflow
from pssflow import _core

STUB = ast.parse((Path(pssflow.__file__).parent / "_core.pyi").read_text(encoding="utf-8"))
CLASSES = {node.name: node for node in STUB.body if isinstance(node, ast.ClassDef)}
FUNCTIONS = {node.name: node for node in STUB.body if isinstance(node, ast.FunctionDef)}
ARGUMENTS = tuple[list[str], int, dict[str, bool]]
"""Names of those by position, how many have defaults, and whether those by name alone have one."""


def _stated(function: ast.FunctionDef) -> ARGUMENTS:
    of = function.args
    named = zip(of.kwonlyargs, of.kw_defaults, strict=True)
    positions = [a.arg for a in of.args if a.arg != "self"]
    return positions, len(of.defaults), {a.arg: default is not None for a, default in named}


def _taken(function: Callable[..., Any]) -> ARGUMENTS:
    found = [p for p in inspect.signature(function).parameters.values() if p.name != "self"]
    named = {p.name: p.default is not p.empty for p in found if p.kind is p.KEYWORD_ONLY}
    positions = [p for p in found if p.kind is not p.KEYWORD_ONLY]
    return [p.name for p in positions], sum(p.default is not p.empty for p in positions), named


def _public(of: object) -> set[str]:
    return {name for name in vars(of) if not name.startswith("_")}


def test_the_stub_names_what_the_extension_has():
    assert _public(_core) == FUNCTIONS.keys() | CLASSES.keys() - {"ForeignGuide"}
    for name in FUNCTIONS:
        assert _taken(getattr(_core, name)) == _stated(FUNCTIONS[name]), name


@pytest.mark.parametrize("name", ["Guide", "Scene"])
def test_methods_take_what_the_stub_says(name):
    members = [node for node in CLASSES[name].body if isinstance(node, ast.FunctionDef)]
    cls = getattr(_core, name)
    assert _public(cls) == {m.name for m in members if m.name != "__init__"}
    for member in members:
        if any(isinstance(d, ast.Name) and d.id == "property" for d in member.decorator_list):
            continue
        found = cls if member.name == "__init__" else getattr(cls, member.name)
        assert _taken(found) == _stated(member), member.name
