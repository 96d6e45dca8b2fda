"""The command `pssflow`: render, compare, inspect, info, and the studies.

Everything here is about arguments and output; what happens is in `render.py` and `compare.py`. Arguments are checked,
and outputs are found to be writable, before the scene is loaded.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from .files import check_writable, first_line
from .options import COMBINATIONS, EMITTER_STRATEGIES, PARAMETRISATIONS, PRESETS
from .params import GuideNames, GuideOption, GuideSetting, Positive, SceneParameter, Size
from .study.registry import Studies
from .terminal import Terminal, run_command
from .thesis import SCENES as THESIS_SCENES

__all__ = ["commands", "main"]

F = TypeVar("F", bound=Callable[..., Any])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the command; returns the exit code."""
    return run_command(commands, arguments)


RECORDED = (
    *("--guide", "--load-guide", "--preset", "--spp", "--time", "--pilot-spp", "--keep-pilot"),
    *(
        "--k",
        "--max-depth",
        "--rr-depth",
        "--parametrisation",
        "--emitter-strategy",
        "--uniform-fraction",
        "--seed",
        "--set",
    ),
)
"""What a record says itself, and cannot be given beside `--replay`."""


def _version(ctx: click.Context, _param: click.Parameter, asked: bool) -> None:
    """The versions that a bug report needs."""
    if not asked or ctx.resilient_parsing:
        return
    import mitsuba as mi

    from . import _core

    click.echo(f"pssflow {_core.__version__} (Mitsuba {mi.__version__})")
    ctx.exit()


@click.group("pssflow", context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_version,
    help="Versions.",
)
def commands() -> None:
    """Learned importance sampling for Mitsuba 3 scenes: the light that arrives after exactly k bounces."""


def _scene_options(command: F) -> F:
    """Which scene, from where, how large."""
    for option in reversed(
        (
            click.argument("scene", metavar="SCENE.xml"),
            click.option("--size", type=Size(), help="Film size in pixels."),
            click.option(
                "--scale", type=Positive("factor", 1e4), help="Factor on the film's size."
            ),
            click.option(
                "-D",
                "parameters",
                type=SceneParameter(),
                multiple=True,
                help="Value of the scene's $key.",
            ),
            click.option(
                "--sensor", type=click.IntRange(0), default=0, show_default=True, help="Its index."
            ),
            click.option(
                "--approximate",
                is_flag=True,
                help="Replace what is not supported, and say what by.",
            ),
            click.option(
                "--variant",
                help="Mitsuba variant.  [default: llvm_ad_rgb, or scalar_rgb without LLVM]",
            ),
        )
    ):
        command = option(command)
    return command


def _render_options(command: F) -> F:
    """What both `render` and `compare` understand. Those without a default leave it to `pssflow.render`."""
    for option in reversed(
        (
            click.option(
                "--spp",
                type=click.IntRange(1, 1 << 24),
                help="Samples per pixel in all, pilot inside.  [default: 16]",
            ),
            click.option(
                "--time",
                "seconds",
                type=Positive("number of seconds"),
                help="Seconds instead: pilot, training and rendering; loading comes before.",
            ),
            click.option("--k", type=click.IntRange(1, 32), help="Bounces.  [default: 2]"),
            click.option(
                "--parametrisation",
                type=click.Choice(PARAMETRISATIONS),
                help="What a direction's numbers mean.  [default: bsdf]",
            ),
            click.option(
                "--uniform-fraction",
                type=click.FloatRange(0.0, 1.0),
                help="Share a of random numbers in the mixture.  [default: the guide's]",
            ),
            click.option(
                "--emitter-strategy",
                type=click.Choice(EMITTER_STRATEGIES),
                help="How the light is joined.  [default: mis]",
            ),
            click.option(
                "--pilot-spp",
                type=click.IntRange(1),
                help="Pilot.  [default: a 32nd of --spp; a quarter for flows]",
            ),
            click.option(
                "--keep-pilot/--discard-pilot",
                default=None,
                help="Whether the pilot enters the image.  [default: keep]",
            ),
            click.option("--seed", type=click.IntRange(0, 2**64 - 1), help="[default: 0]"),
            click.option("--threads", type=click.IntRange(1, 4096), help="[default: one a core]"),
            click.option(
                "--combine",
                type=click.Choice(COMBINATIONS),
                help="Weights of the passes: by samples (default, unbiased) or by variance.",
            ),
            click.option(
                "--preset", type=click.Choice(tuple(PRESETS)), help="Settings of the source thesis."
            ),
            click.option(
                "--set",
                "settings",
                type=GuideSetting(),
                multiple=True,
                help="Option of a guide, as realnvp.epochs=7; `pssflow info` lists them.",
            ),
            click.option("--json", "as_json", is_flag=True, help="Print one JSON object."),
            click.option("-q", "--quiet", is_flag=True, help="No progress, no notices."),
        )
    ):
        command = option(command)
    return command


@commands.command()
@_scene_options
@click.option("-o", "--output", required=True, metavar="OUT.exr", help="Image and variance.")
@click.option(
    "--guide",
    help="`auto` (whatever pays, or none), `none` (random numbers), a guide's name, or a saved one.  [default: auto]",
)
@_render_options
@click.option(
    "--max-depth",
    type=int,
    help="All light up to this depth, as Mitsuba counts it (1: emission, 2: and direct light), in place of --k.",
)
@click.option(
    "--rr-depth",
    type=int,
    help="With --max-depth, bounces from which on long paths are left to chance.  [default: none]",
)
@click.option("--explain", is_flag=True, help="Print what `auto` considered, and why.")
@click.option("--replay", metavar="RESULT.json", help="Repeat the recorded run, bit for bit.")
@click.option("--save-guide", metavar="FILE", help="Save what was learned.")
@click.option("--load-guide", metavar="FILE", help="Use a saved guide; no pilot is spent.")
@click.pass_obj
def render(
    terminal: Terminal,
    *,
    output: str,
    guide: str | None,
    explain: bool,
    replay: str | None,
    save_guide: str | None,
    load_guide: str | None,
    quiet: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Render the light of exactly k bounces; writes OUT.exr, and its record beside it as OUT.json."""
    from . import report
    from .guide import Guide, usual_guide
    from .options import read_replay
    from .output import write_json

    terminal.quiet = quiet
    given = options | {"guide": guide, "replay": replay, "load_guide": load_guide}
    _exclude(given, "--guide", "--load-guide")
    for other in RECORDED:
        _exclude(given, "--replay", other)
    _exclude(options, "--spp", "--time")
    for other, value in (
        ("--k", options["k"]),
        ("--load-guide", load_guide),
        ("--save-guide", save_guide),
    ):
        if options["max_depth"] is not None and value is not None:
            raise click.UsageError(
                f"{other} is for light of one k, and was given beside --max-depth"
            )
    target = _exr(output)
    record_target = target.with_suffix(".json")
    for path in (record_target, save_guide):
        if path is not None:
            check_writable(path)
    record = None if replay is None else read_replay(_one_run(replay))
    name = record["guide"] if record else load_guide or guide or usual_guide(options["preset"])
    if load_guide is not None and not Path(load_guide).is_file():
        raise FileNotFoundError(f"{load_guide}: there is no such file")
    if save_guide is not None and name == "none":
        raise click.UsageError("--save-guide was given, but the guide `none` learns nothing")
    settings = _settings(options, [name])[name]
    scene = _load(terminal, options)
    result = scene.render(
        Path(load_guide) if load_guide else name,
        replay=record,
        progress=not quiet,
        **_arguments(options),
        **settings,
    )
    for note in result.notes:
        terminal.note(note)
    if save_guide is not None:
        if isinstance(result.guide, Guide):
            result.guide.save(save_guide)
        else:
            terminal.note(f"{save_guide} was not written: nothing was learned")
    result.write(target)
    write_json(record_target, result.stats)
    if as_json:
        terminal.json(result.stats)
    else:
        terminal.out.print(_headline(scene, result.stats), highlight=False, soft_wrap=True)
        terminal.out.print(report.runs_table([result.stats]))
        if result.parts:
            terminal.out.print(report.lengths_table(result.stats))
        elif explain:
            terminal.out.print(report.candidates_table(result.stats))
        elif result.stats["candidates"]:
            terminal.out.print(report.choice_line(result.stats), highlight=False, soft_wrap=True)
        terminal.out.print(f"wrote {target} and {record_target}", highlight=False, soft_wrap=True)


@commands.command()
@_scene_options
@click.option(
    "--guides",
    type=GuideNames(),
    default="none,realnvp,auto",
    show_default=True,
    help="Guides, joined by commas.",
)
@_render_options
@click.option("--reference", metavar="REF.exr", help="Compare with this image.")
@click.option(
    "--reference-time",
    type=Positive("number of seconds"),
    default=120.0,
    show_default=True,
    help="Seconds for Mitsuba's reference, at most.",
)
@click.option(
    "--thesis",
    type=click.Choice(tuple(THESIS_SCENES)),
    help="Print the source thesis' shares of this scene beside those of none and realnvp.",
)
@click.option(
    "-o", "--output", default="out/compare", show_default=True, metavar="DIR", help="Folder."
)
@click.pass_obj
def compare(
    terminal: Terminal,
    *,
    guides: tuple[str, ...],
    output: str,
    reference: str | None,
    reference_time: float,
    thesis: str | None,
    quiet: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Render with several guides beside Mitsuba's reference; writes EXRs, a picture and results.json to DIR."""
    from . import report
    from .compare import compare as run_comparison
    from .compare import results_folder

    terminal.quiet = quiet
    _exclude(options, "--spp", "--time")
    if reference is not None and not Path(reference).is_file():
        raise FileNotFoundError(f"{reference}: there is no such file")
    settings = _settings(options, guides)
    with results_folder(output) as folder:
        scene = _load(terminal, options)
        comparison = run_comparison(
            scene,
            [(name, settings[name]) for name in guides],
            _arguments(options),
            reference_file=reference,
            reference_time=reference_time,
            progress=not quiet,
            note=terminal.note,
        )
        written = comparison.write(folder)
    beside = None if thesis is None else THESIS_SCENES[thesis]
    if as_json:
        told = {} if beside is None else {"thesis": beside.describe()}
        terminal.json(comparison.record() | told)
    else:
        headline = _headline(scene, comparison.runs[0].stats)
        terminal.out.print(headline, highlight=False, soft_wrap=True)
        terminal.out.print(report.runs_table(comparison.records(), beside))
        if beside is not None:
            terminal.out.print(f"thesis: {beside.caption}", highlight=False, soft_wrap=True)
        terminal.out.print(comparison.reference_line(), highlight=False, soft_wrap=True)
        names = ", ".join(path.name for path in written)
        terminal.out.print(f"wrote {folder}: {names}", highlight=False, soft_wrap=True)


@commands.command("inspect")
@_scene_options
@click.option("-o", "--output", required=True, metavar="OUT.png", help="The picture.")
@click.option("--pixel", metavar="X,Y", help="Look at the surface seen there.")
@click.option("--map", "as_map", is_flag=True, help="Look at the whole image.")
@click.option(
    "--guides",
    type=GuideNames(),
    default="direction-table,auto",
    show_default=True,
    help="Guides, joined by commas.",
)
@click.option(
    "--spp", type=click.IntRange(4, 1 << 24), default=16, show_default=True, help="Of each render."
)
@click.option("--k", type=click.IntRange(1, 32), default=2, show_default=True, help="Bounces.")
@click.option("--seed", type=click.IntRange(0, 2**64 - 1), default=0, show_default=True)
@click.option("--threads", type=click.IntRange(1, 4096), help="[default: one a core]")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def inspect_command(
    terminal: Terminal,
    *,
    output: str,
    pixel: str | None,
    as_map: bool,
    guides: tuple[str, ...],
    spp: int,
    k: int,
    seed: int,
    threads: int | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Draw what a surface is lit by and what guides make of it (--pixel), or where in the image they pay (--map)."""
    from .guide import choose
    from .inspect import at_pixel, over_image

    terminal.quiet = quiet
    if (pixel is None) != as_map:
        raise click.UsageError("give one of --pixel X,Y and --map")
    if not output.lower().endswith(".png"):
        raise click.UsageError(f"--output {output!r} must end in .png")
    check_writable(output)
    for guide in guides:
        choose(guide, {})
    place = None if pixel is None else _column_and_row(pixel)
    _exclude(options, "--size", "--scale")
    scene = _load(terminal, options)
    common: dict[str, Any] = {
        "spp": spp, "k": k, "seed": seed, "threads": threads, "progress": not quiet,
    }  # fmt: skip
    if place is None:
        over_image(scene, guides, **common).draw(output)
    else:
        at_pixel(scene, place, guides, **common).draw(output)
    terminal.out.print(f"wrote {output}", highlight=False, soft_wrap=True)


def _column_and_row(text: str) -> tuple[int, int]:
    try:
        x, y = (int(part) for part in text.split(","))
    except ValueError:
        raise click.UsageError(f"--pixel {text!r}: expected a column and a row, as 64,48") from None
    return x, y


@commands.command()
@_scene_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@click.pass_obj
def info(terminal: Terminal, *, as_json: bool, **options: Any) -> None:
    """Say what was understood of a scene, where its light is, what is not supported, and which guides there are."""
    from . import report
    from .guide import registry
    from .info import inspect
    from .scene import load_scene, resize_film

    notes: list[str] = []
    _set_variant(options["variant"], notes)
    _exclude(options, "--size", "--scale")
    loaded, name = load_scene(options["scene"], notes, **dict(options["parameters"]))
    if options["size"] or options["scale"]:
        resize_film(loaded, options["sensor"], options["size"], options["scale"])
    found = inspect(loaded, options["sensor"], approximate=options["approximate"])
    for note in [*notes, *found["notes"]]:
        terminal.note(note)
    record = {"scene": name, **found, "guides": registry()}
    if as_json:
        terminal.json(record)
    else:
        for part in report.scene_info(record):
            terminal.out.print(part, soft_wrap=isinstance(part, str), highlight=False)


@commands.group(cls=Studies)
def study() -> None:
    """Measure methods on many scenes: tables, charts, and a row a run; what was interrupted resumes."""


def _exr(output: str) -> Path:
    path = Path(output)
    if path.suffix.lower() != ".exr":
        raise click.UsageError(f"--output {output!r} must end in .exr")
    check_writable(path)
    return path


def _exclude(options: Mapping[str, Any], first: str, second: str) -> None:
    """Refuses two options that contradict each other."""
    names = {"--time": "seconds", "--set": "settings"}
    values = [options.get(names.get(o, o[2:].replace("-", "_"))) for o in (first, second)]
    if all(value is not None and value != () for value in values):
        raise click.UsageError(f"{first} and {second} were both given; give one")


def _set_variant(name: str | None, notes: list[str]) -> None:
    """Sets Mitsuba's variant, the best that works here if none is asked for, and silences Mitsuba's own warnings.

    Those come in colour, with a date, from sources that nobody here has; what matters of them, the export says itself.
    """
    import mitsuba as mi

    from .variants import VARIANTS, ensure_variant, llvm_problem

    if name is None:
        notice = ensure_variant()
        mi.set_log_level(mi.LogLevel.Error)
        if notice:
            notes.append(notice)
        return
    if name not in VARIANTS:
        raise click.UsageError(
            f"--variant {name!r} is not supported (supported: {', '.join(VARIANTS)})"
        )
    problem = llvm_problem() if name.startswith("llvm") else None
    if problem:
        raise RuntimeError(f"--variant {name}: {problem}")
    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)


def _load(terminal: Terminal, options: Mapping[str, Any]) -> Any:
    """The scene, ready to be traced; its notices are shown."""
    from .scene import Scene

    notes: list[str] = []
    _set_variant(options["variant"], notes)
    for note in notes:
        terminal.note(note)
    return Scene(
        options["scene"],
        options["sensor"],
        size=options["size"],
        scale=options["scale"],
        approximate=options["approximate"],
        **dict(options["parameters"]),
    )


def _arguments(options: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `pssflow.render` that were given; what was not is left to it, so that a preset can set it."""
    names = {"time": "seconds"} | {
        name: name
        for name in (
            "spp",
            "k",
            "max_depth",
            "rr_depth",
            "parametrisation",
            "uniform_fraction",
            "emitter_strategy",
            "pilot_spp",
            "keep_pilot",
            "combine",
            "seed",
            "threads",
            "preset",
        )
    }
    return {to: options[name] for to, name in names.items() if options.get(name) is not None}


def _settings(options: Mapping[str, Any], guides: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Options of each guide, by guide. Unknown guides and options without their guide are refused before any work."""
    from .guide import choose

    chosen: dict[str, dict[str, Any]] = {guide: {} for guide in guides}
    settings: Sequence[GuideOption] = options["settings"]
    for setting in settings:
        owners = [guide for guide in guides if setting.guide in guide.split("+")]
        if not owners:
            raise click.UsageError(
                f"--set {setting.guide}.{setting.name}: {setting.guide!r} is not among the guides "
                f"({', '.join(guides)})"
            )
        for guide in owners:
            chosen[guide][f"{setting.guide}.{setting.name}"] = setting.value
    for guide in guides:
        choose(guide, chosen[guide])
    return chosen


def _one_run(path: str) -> Any:
    """The run in a JSON file: a run by itself, or the only one of a comparison that learned something."""
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: is no JSON: {first_line(error)}") from None
    if isinstance(value, dict) and isinstance(value.get("runs"), list):
        raise ValueError(
            f"{path}: holds {len(value['runs'])} runs; give the .json of one of them, beside its .exr"
        )
    return path


def _headline(scene: Any, stats: Mapping[str, Any]) -> str:
    """What all rows of a table share."""
    if stats["k"] is None:
        what = f"all light to depth {stats['max_depth']}"
    else:
        what = "light of exactly " + ("1 bounce" if stats["k"] == 1 else f"{stats['k']} bounces")
    return (
        f"{scene.name}: {what}, {scene.width}×{scene.height}, "
        f"{stats['parametrisation']}, {stats['emitter_strategy']}, seed {stats['seed']}"
    )


if __name__ == "__main__":
    sys.exit(main())
