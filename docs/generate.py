"""Lists of pages that are made from the code, and blocks that are files of `examples/`: `python
docs/generate.py` writes them anew. As a hook of MkDocs, this file draws formulas.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from html import unescape
from pathlib import Path
from typing import Any, get_args

import click
import msgspec
from msgspec.inspect import type_info

from safevar_sumo import ads
from safevar_sumo.ads import ADS
from safevar_sumo.cli.command import COMMON_NAMES, ENDED_OPTIONS
from safevar_sumo.cli.program import COMMANDS_BY_GROUP, ENDED_COMMANDS, commands
from safevar_sumo.metrics import METRICS, OPTIONAL_METRICS, PUBLISHED_SCORING
from safevar_sumo.results import FILES
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study, study_names
from safevar_sumo.study.file import ENDED_KEYS, ENDED_STUDIES
from safevar_sumo.vehicles import VEHICLES

DOCS = Path(__file__).parent
PLAIN = {
    "StrType": "text",
    "IntType": "integer",
    "FloatType": "number",
    "BoolType": "true or false",
    "AnyType": "any value",
}


MARKED = re.compile(
    r"(<!-- generated: (\w+) -->\n).*?(?=<!-- end of what is generated -->)", re.DOTALL
)
"""A list of a page, with the mark above it."""
EXAMPLE = re.compile(
    r"(<!-- file: (\S+) -->\n```[^\n]*\n).*?(?=^```$)", re.DOTALL | re.MULTILINE
)
"""A block of a page that has the content of a file, with the mark above it."""


def filled(page: str) -> str:
    """A page with its lists as the code has them now, and with examples as their files are."""
    with_lists = MARKED.sub(
        lambda match: f"{match[1]}\n{LISTS[match[2]]().strip()}\n\n", page
    )
    return EXAMPLE.sub(
        lambda match: match[1] + (DOCS.parent / match[2]).read_text("utf-8"), with_lists
    )


def on_page_content(html: str, **_: Any) -> str:
    """Called by MkDocs for every page: formulas, which arithmatex marks, become MathML, which
    browsers draw themselves.
    """
    from latex2mathml.converter import (
        convert,  # the rest of this module works without it
    )

    def formula(display: str, match: re.Match[str]) -> str:
        return str(convert(unescape(match[1].strip()), display=display))

    for mark, display in (
        (r"\\\((.*?)\\\)</span>", "inline"),
        (r"\\\[(.*?)\\\]</div>", "block"),
    ):
        html = re.sub(
            rf'<(?:span|div) class="arithmatex">{mark}',
            partial(formula, display),
            html,
            flags=re.DOTALL,
        )
    return html


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = list(heads)
    return (
        "\n".join(
            f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows)
        )
        + "\n"
    )


def _default(value: Any) -> str:
    if value is msgspec.NODEFAULT or value is inspect.Parameter.empty:
        return "required"
    if value is None:
        return "none"
    return (
        "its own defaults"
        if isinstance(value, msgspec.Struct)
        else f"`{msgspec.json.encode(value).decode()}`"
    )


def _range(kind: Any) -> str:
    bounds = [
        f"{sign} {value:g}"
        for name, sign in (
            ("gt", ">"),
            ("ge", "at least"),
            ("lt", "<"),
            ("le", "at most"),
        )
        if (value := getattr(kind, name, None)) is not None
    ]
    return f", {', '.join(bounds)}" if bounds else ""


def _words(kind: Any) -> str:
    """A type in words."""
    name = type(kind).__name__
    match name:
        case "Metadata":
            words = _words(kind.type)
        case "StructType":
            words = f"[{kind.cls.__name__}](#{kind.cls.__name__.lower()})"
        case "UnionType":
            parts = [part for part in kind.types if type(part).__name__ != "NoneType"]
            words = " or ".join(_words(part) for part in parts)
        case "LiteralType":
            words = " or ".join(f'`"{value}"`' for value in kind.values)
        case "ListType" | "VarTupleType":
            words = f"list of {_words(kind.item_type)}"
        case "TupleType":
            words = f"list of {', '.join(_words(item) for item in kind.item_types)}"
        case "DictType":
            words = f"table of {_words(kind.value_type)} by name"
        case _:
            words = PLAIN[name] + _range(kind)
    return words


def _structs(kind: Any) -> Iterator[Any]:
    """A table of a study file, then all tables that stand in it."""
    if type(kind).__name__ == "StructType":
        yield kind
        for field in kind.fields:
            yield from _structs(field.type)
    inner = ("item_type", "value_type", "type")  # `type` of an annotated one
    parts = (getattr(kind, name) for name in inner if hasattr(kind, name))
    for part in [*getattr(kind, "types", ()), *getattr(kind, "item_types", ()), *parts]:
        yield from _structs(part)


def study_keys() -> str:
    """Every table of a study file with its keys."""
    parts = []
    for kind in {
        one.cls: one
        for one in _structs(type_info(Study))
        if one.cls.__name__ != "Origin"
    }.values():
        rows = [
            (
                f"`{field.encode_name}`",
                _words(field.type),
                _default(
                    field.default
                    if field.default_factory is msgspec.NODEFAULT
                    else field.default_factory()
                ),
            )
            for field in kind.fields
            if field.name != "origin"
        ]
        table = _table(("key", "value", "default"), rows)
        parts.append(
            f"### {kind.cls.__name__}\n\n{inspect.getdoc(kind.cls)}\n\n{table}"
        )
    return "\n".join(parts)


def models(classes: Mapping[str, Any]) -> Callable[[], str]:
    """Every model of a kind with its parameters."""

    def text() -> str:
        parts = []
        for name, model in classes.items():
            doc = inspect.getdoc(model) or ""
            described = {
                key.strip(): " ".join(meaning.split())
                for keys, meaning in re.findall(
                    r"^(\w[\w, ]*)\n((?:    .*\n?)+)",
                    doc.partition("Parameters\n----------\n")[2],
                    flags=re.MULTILINE,
                )
                for key in keys.split(",")
            }
            rows = [
                (
                    f"`{one.name}`",
                    described.get(one.name, ""),
                    _bounds(one.annotation),
                    _default(one.default),
                )
                for one in inspect.signature(model).parameters.values()
            ]
            table = (
                _table(("parameter", "meaning", "range", "default"), rows)
                if rows
                else "No parameters.\n"
            )
            parts.append(
                f"### {name}\n\n{doc.partition('Parameters')[0].strip()}\n\n{table}"
            )
        return "\n".join(parts)

    return text


def _bounds(annotation: Any) -> str:
    """The range of an annotated number, or of the number that may be None."""
    metas = [
        meta
        for kind in (annotation, *get_args(annotation))
        for meta in getattr(kind, "__metadata__", ())
    ]
    return _range(metas[0]).removeprefix(", ") if metas else ""


def metric_columns() -> str:
    """Columns of metrics and objectives in solutions.csv."""
    objectives = [
        (f"`{one.name}`", one.unit, f"objective: {one.title}")
        for one in PUBLISHED_SCORING.objectives
    ]
    metrics = [
        (f"`{name}`", metric.unit, metric.description)
        for name, metric in {**METRICS, **OPTIONAL_METRICS}.items()
    ]
    return _table(("column", "unit", "content"), [*objectives, *metrics])


def results_files() -> str:
    """Every file of a results directory."""
    return _table(
        ("file", "content", "written by"),
        [(f"`{name}`", content, writer) for name, content, writer in FILES],
    )


def readme() -> str:
    """The README of the repository, whose links go to this folder, without comments and without
    its badges, which are loaded from elsewhere.
    """
    text = (DOCS.parent / "README.md").read_text().replace("](docs/", "](")
    return re.sub(r"^\[!\[.*\n\n|^<!--(.|\n)*?-->\n+", "", text, flags=re.MULTILINE)


def command_list() -> str:
    """Every command with its own options, below the options of many commands."""
    common = {
        f"--{name.replace('_', '-')}"
        for names in COMMON_NAMES.values()
        for name in names
    }
    shared = {
        flag: text
        for flag, text in _options("risk").items()
        if flag.split()[0] in common
    }
    parts = ["## Options of many commands", _option_table(shared)]
    for title, group in COMMANDS_BY_GROUP.items():
        parts.append(f"## {title}")
        for name in group:
            command = _command(name)
            context = click.Context(command)
            places = [one for one in command.params if isinstance(one, click.Argument)]
            usage = " ".join([name, *(place.make_metavar(context) for place in places)])
            own = {
                flag: text
                for flag, text in _options(name).items()
                if text not in shared.values()
            }
            parts += [f"### {name}", f"`{usage}`", inspect.cleandoc(str(command.help))]
            parts += [_option_table(own)] if own else []
    return "\n\n".join(part.strip() for part in parts)


def _command(name: str) -> click.Command:
    command = commands.get_command(click.Context(commands), name)
    assert command is not None
    return command


def _options(name: str) -> dict[str, str]:
    """The options of a command as its help explains them; `--help-all` is the last one."""
    context = click.Context(_command(name))
    options = [one for one in context.command.params if isinstance(one, click.Option)]
    records = [option.get_help_record(context) for option in options]
    return dict(record for record in records[:-1] if record)


def _option_table(options: dict[str, str]) -> str:
    rows = [(f"`{flag}`", text) for flag, text in options.items()]
    return _table(
        ("option", "meaning"),
        [[cell.replace("|", "\\|") for cell in row] for row in rows],
    )


def characteristics() -> str:
    """Every characteristic of the shipped vehicles, by the first study that has it."""
    seen = dict[tuple[str, str], tuple[str, ...]]()
    for study in map(read_study, study_names()):
        for key, row in study.vehicle.characteristics.items():
            model = study.vehicle.model
            how = f"{'' if row.workshop else 'not in a workshop: '}{row.measurement}"
            seen.setdefault(
                (model, key),
                (f"`{model}`", f"`{key}`", row.unit, row.meaning, row.counterpart, how),
            )
    return _table(
        (
            *(
                "vehicle",
                "characteristic",
                "unit",
                "name (what it is)",
                "real-world counterpart",
            ),
            "how a workshop measures it",
        ),
        seen.values(),
    )


def published_systems() -> str:
    """The source of the driving systems that are put in front of published libraries."""
    folder = Path(ads.__file__).parent
    parts = [
        (name, (folder / name).read_text())
        for name in ("highway_idm.py", "intel_rss.py")
    ]
    return "\n".join(
        f"`safevar_sumo/ads/{name}`:\n\n```python\n{text}```\n" for name, text in parts
    )


def ended() -> str:
    """What earlier releases had, and what replaces it, as the refusals of commands say it."""
    kinds = {
        "command or option": {**ENDED_COMMANDS, **ENDED_OPTIONS},
        "key of a study": ENDED_KEYS,
        "shipped study": ENDED_STUDIES,
    }
    return "\n".join(
        _table(
            (kind, "use instead"),
            [(f"`{name}`", instead) for name, instead in replacements.items()],
        )
        for kind, replacements in kinds.items()
    )


LISTS: dict[str, Callable[[], str]] = {
    "readme": readme,
    "commands": command_list,
    "published_systems": published_systems,
    "characteristics": characteristics,
    "study_keys": study_keys,
    "vehicles": models(VEHICLES),
    "ads": models(ADS),
    "algorithms": models(ALGORITHMS),
    "metric_columns": metric_columns,
    "results_files": results_files,
    "ended": ended,
}

if __name__ == "__main__":
    # The index is made from README.
    for path in (DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))):
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
