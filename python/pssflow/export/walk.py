"""What the converters of all plugins share: reading Mitsuba's objects, collecting entries, refusing what is not known.

A *converter* turns one object into one entry of the description. It reads the object, never the file that it was loaded
from, so that an edited scene exports its new state. Three sources, in this order: an object's methods, its traversed
parameters (`Fields`), and, for switches that Mitsuba shows nowhere else, its printed form (`printed`). Numbers never
come from the printed form: it has six digits.
"""

from __future__ import annotations

import functools
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import DTypeLike, NDArray

from .approximate import INSTEAD, replacement
from .names import PLUGIN_NAMES

Entry = dict[str, Any]
"""One JSON object of the description."""

MISSING = -1
"""Index of an entry that was refused. It never leaves the exporter, which raises first."""

Choice = TypeVar("Choice")


class UnsupportedError(ValueError):
    """A scene holds something that pssflow cannot render; the message names it, what is supported, and what to do."""


class RefusedError(Exception):
    """Raised by a converter whose plugin is known but whose settings are not; the text says which, in one line."""


class Unsupported(NamedTuple):
    """One thing that cannot be rendered."""

    kind: str
    """Kind of plugin, a key of `SUPPORTED`."""
    plugin: str
    """Mitsuba's name of the plugin, or its class where we know no name."""
    where: str
    """Path of the object, as `mi.traverse` would name it."""
    shape: str | None
    """Id of the first shape that uses it."""
    reason: str | None
    """What about it, where the plugin itself is supported."""

    @property
    def instead(self) -> str | None:
        """What `--approximate` would do; None where it cannot help."""
        return INSTEAD.get(self.kind)

    def __str__(self) -> str:
        kind = "plugin" if self.where == self.shape and self.kind == "shape" else self.kind
        owner = "" if self.shape is None else f'shape "{self.shape}": '
        named = "" if self.where == self.shape else f' ("{self.where}")'
        return f'{owner}{kind} "{self.plugin}"{named} {self.reason or "is not supported"}'


class Converter(NamedTuple):
    """A row of a registry: how one class of Mitsuba's becomes an entry."""

    plugin: str
    """Mitsuba's name of the plugin."""
    type: str
    """The schema's name of the entry."""
    convert: Callable[..., Entry]
    """(walk, object, where, …) → the entry without `type` and `id`; raises `RefusedError`."""


class Walk:
    """The state of one export: the entries and arrays so far, and what had to be refused."""

    def __init__(self, names: Mapping[Hashable, str], *, approximate: bool = False) -> None:
        self.approximate = approximate
        """Whether what is not supported is replaced, with a note, where that can be."""
        self.arrays: list[NDArray[Any]] = []
        self.entries: dict[str, list[Entry]] = defaultdict(list)
        self.counts: dict[str, Counter[str]] = defaultdict(Counter)
        self.unsupported: list[Unsupported] = []
        self.notes: list[str] = []
        self.shape: str | None = None
        """Id of the shape being converted, for messages."""
        self.bsdfs: Mapping[str, Converter] = {}
        """The registry of BSDFs, which only their own module knows."""
        self.groups: dict[str, Any] = {}
        """Shapegroups of the scene by name."""
        self.group_indices: dict[str, int] = {}
        """Index of each group that an instance showed so far."""
        self.suns: list[Any] = []
        """The sky that each entry of `entries["sun"]` came out of."""
        self.shutter = (0.0, 0.0)
        """When the sensor's shutter opens, and for how long."""
        self._names = names
        self._indices: dict[tuple[str, Hashable], int] = {}
        self._attributes: dict[Hashable, tuple[str, ...]] = {}

    def add_array(self, array: NDArray[Any]) -> int:
        """Appends an array and returns its index. Each index is used by one entry: the other side takes arrays over."""
        self.arrays.append(array)
        return len(self.arrays) - 1

    def convert(
        self, table: Mapping[str, Converter], kind: str, obj: Any, where: str, *args: Any
    ) -> Entry | None:
        """The entry of an object by the registry of its kind; None, and a line in `unsupported`, if there is none."""
        if obj is None:
            self.refuse(kind, "none", where, "is missing")
            return None
        converter = table.get(class_of(obj))
        if converter is None:
            return self._replace(kind, plugin_of(obj), obj, where, None, args)
        try:
            entry = converter.convert(self, obj, where, *args)
        except RefusedError as refused:
            return self._replace(kind, converter.plugin, obj, where, str(refused), args)
        self.counts[kind][converter.plugin] += 1
        return {"type": converter.type, "id": where, **entry}

    def shared(self, table: Mapping[str, Converter], kind: str, obj: Any, where: str) -> int:
        """Index of an object that several others may use: converted when first met, and named by that place."""
        known = self._indices.get((kind, obj))
        if known is not None:
            return known
        entry = self.convert(table, kind, obj, self._names.get(obj, where))
        index = MISSING
        if entry is not None:
            index = len(self.entries[kind])
            self.entries[kind].append(entry)
        self._indices[kind, obj] = index
        return index

    def attributes_of(self, obj: Any) -> tuple[str, ...]:
        """Names of the mesh attributes that an object and its children look up, sorted; found once for each object."""
        known = self._attributes.get(obj)
        if known is None:
            names: set[str] = set()
            if class_of(obj) == "MeshAttribute":
                names.add(printed(obj).get("name", "").strip('"'))
            for child in Fields(obj).children.values():
                names.update(self.attributes_of(child))
            known = self._attributes[obj] = tuple(sorted(names))
        return known

    def refuse(
        self,
        kind: str,
        plugin: str,
        where: str,
        reason: str | None = None,
        instead: str | None = None,
    ) -> None:
        """Notes that something cannot be rendered; the walk goes on, so that all such things are known at its end.

        `instead`: what is done in its place where the walk approximates.
        """
        thing = Unsupported(kind, plugin, where, self.shape, reason)
        if self.approximate and instead is not None:
            self.notes.append(f"approximated: {thing}; it {instead}")
        else:
            self.unsupported.append(thing)

    @staticmethod
    def children(obj: Any) -> dict[str, Any]:
        """The objects that an object holds, by name."""
        return Fields(obj).children

    def bsdf(self, obj: Any, where: str) -> int:
        """Index of a BSDF, converted when first met."""
        return self.shared(self.bsdfs, "BSDF", obj, where)

    def _replace(
        self,
        kind: str,
        plugin: str,
        obj: Any,
        where: str,
        reason: str | None,
        args: tuple[Any, ...],
    ) -> Entry | None:
        """An entry in the place of one that is not supported, or None, and a line in `unsupported`."""
        owner = args[1] if kind == "emitter" else None
        found = replacement(self, kind, obj, where, owner) if self.approximate else None
        self.refuse(kind, plugin, where, reason, None if found is None else found[1])
        return None if found is None else {"id": where, **found[0]}


class Fields:
    """An object's parameters and children as `mi.traverse` sees them now, one level deep, read when asked for."""

    def __init__(self, obj: Any) -> None:
        collector = _collector_type()()
        obj.traverse(collector)
        self._owner = obj
        self._values: dict[str, tuple[Any, Any]] = collector.values
        self.children: dict[str, Any] = collector.children

    def __contains__(self, name: str) -> bool:
        return name in self._values or name in self.children

    def __getitem__(self, name: str) -> Any:
        """A parameter's value or a child.

        Raises:
            RefusedError: there is none of this name, as in a version of Mitsuba that we do not know.
        """
        if name in self.children:
            return self.children[name]
        if name not in self._values:
            raise RefusedError(
                f"has no parameter `{name}` in Mitsuba {mi.__version__}; this pssflow was written for 3.9"
            )
        value, cpptype = self._values[name]
        return value if cpptype is None else mi.get_property(value, cpptype, self._owner)


@functools.cache
def _collector_type() -> type:
    """The callback of `Fields`. Made on first use, because its base class exists only once a variant is set."""

    class Collector(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.values: dict[str, tuple[Any, Any]] = {}
            self.children: dict[str, Any] = {}

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.children[name] = value
            else:
                self.values[name] = (value, cpptype)

    return Collector


def is_scalar() -> bool:
    """Whether the active variant is a scalar one, whose calls take one point at a time."""
    return (mi.variant() or "").startswith("scalar")


def class_of(obj: Any) -> str:
    """Name of an object's class without the storage type that templates append (`BitmapTextureImpl[uint8]`)."""
    return obj.class_name().partition("[")[0]


def plugin_of(obj: Any) -> str:
    """The plugin's name as users write it in a scene, else the class."""
    return PLUGIN_NAMES.get(class_of(obj), class_of(obj))


def floats(value: Any, count: int, name: str) -> list[float]:
    """The numbers of a scalar, colour, point or matrix (rows first) of any variant.

    Raises:
        RefusedError: there are not `count` of them, or one is not finite.
    """
    numbers = np.asarray(dr.detach(value), dtype=np.float64).ravel()
    if numbers.size != count:
        raise RefusedError(f"has a `{name}` of {numbers.size} numbers instead of {count}")
    if not np.isfinite(numbers).all():
        raise RefusedError(f"has a `{name}` that is not finite: {numbers.tolist()}")
    return numbers.tolist()


def number(value: Any, name: str) -> float:
    """One finite number; raises `RefusedError` as `floats` does."""
    return floats(value, 1, name)[0]


def matrix(transform: Any, name: str) -> list[float]:
    """A transform's matrix, rows first: 16 numbers in 3-D, 9 in 2-D."""
    size = 9 if "3f" in type(transform).__name__ else 16
    return floats(transform.matrix, size, name)


def rows(value: Any, columns: int, dtype: DTypeLike, name: str) -> NDArray[Any]:
    """A flat buffer as a C-contiguous array (n, columns), copied only where its type differs."""
    flat = np.ascontiguousarray(dr.detach(value).numpy(), dtype)
    if flat.size % columns:
        raise RefusedError(
            f"has {flat.size} numbers in `{name}`, which is no multiple of {columns}"
        )
    return flat.reshape(-1, columns)


def printed(obj: Any) -> dict[str, str]:
    """The `name = value` pairs of an object's printed form, its children's excluded.

    Understands `Class[a = 1, b = "x[", c = Child[a = 2]]` however it is indented: a pair ends at a comma or a line's
    end that no bracket and no quotation mark encloses.
    """
    text = str(obj)
    pairs: dict[str, str] = {}
    depth, quoted, start = 0, False, text.find("[") + 1
    for i, c in enumerate(text):
        if c == '"':
            quoted = not quoted
        elif quoted:
            continue
        elif c in "[({":
            depth += 1
        elif c in "])}":
            depth -= 1
        if (depth == 1 and c in ",\n") or (depth == 0 and c == "]"):
            name, equals, value = text[start:i].partition(" = ")
            if equals:
                pairs.setdefault(name.strip(), value.strip())
            start = i + 1
    return pairs


def sampling_weight(obj: Any) -> float:
    """An emitter's weight when one is chosen."""
    return number(obj.sampling_weight(), "sampling_weight")


SWITCH: Mapping[str, bool] = {"0": False, "1": True, "false": False, "true": True}
"""How Mitsuba prints a bool."""


def switch(pairs: Mapping[str, str], name: str, choices: Mapping[str, Choice]) -> Choice:
    """What a printed setting means; raises `RefusedError` where it is absent or has no meaning to us."""
    value = pairs.get(name, "nothing")
    if value not in choices:
        raise RefusedError(
            f"has `{name}` = {value}, expected one of {', '.join(choices)}; "
            f"is this Mitsuba {mi.__version__} newer than pssflow?"
        )
    return choices[value]
