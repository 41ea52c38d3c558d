"""Write pages while the site is built, from the package itself: an MkDocs hook.

- `configuration.md`: The types, bounds, defaults and explanations come from the schema of `Config`,
  the refusals from its checks, and the values of the shipped files from the files.
- Tables in pages that hold `<!-- table: NAME -->`: those of quantities that may differ come from
  `QUANTITIES` and the shipped files, that of JAX's primitives from `onekernel`.
- `api/ROOM/...`: The public names and the modules of each room come from its folder; the
  navigation has them below the page of public names.
- `contributing.md`: `CONTRIBUTING.md` of the repository.
- Each page as Markdown beside its HTML, where the links of `llms.txt` lead.

Nothing of this is written by hand.
"""

import ast
import importlib
import inspect
import itertools
import json
import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from ruamel.yaml import YAML

from jetbot_mjx.config import (
    CHANGEABLE_ON_RESUME,
    QUANTITIES,
    Caster,
    Config,
    ConfigError,
    LookParams,
    MjcfRobotConfig,
    RandomizationConfig,
    RobotConfig,
    RobotParams,
    load_config,
    parse_config,
)
from onekernel.lower.jaxpr import primitives

ROOT = Path(__file__).parents[1]
PAGE = "configuration.md"
CONTRIBUTING = "contributing.md"
API = "api/index.md"
"""The page below which the navigation has the generated reference."""

_INTRODUCTION = """\
# Configuration reference

On this page you look up every setting: its type and bounds, its default, and its meaning. A YAML
file names only what differs from the defaults below, and `--set` changes one setting:

```sh
jetbot-mjx train jetbot --set ppo.learning_rate=3e-4 --seed 7
```

The value after `--set` is read as YAML, and the last one wins. All settings are checked before
anything else happens. The run folder's `config.yaml` holds every key, written out. The build of
this site generates this page from `jetbot_mjx.config`, so it shows what the code checks.

YAML here is version 1.2: `1e-3` and `2_621_440` are numbers, `3e7` is accepted as a count, and a
key that is given twice is an error.

Settings marked ↻ may change when a run is [resumed](stop-and-resume.md#what-may-change); all others
are fixed for the run.
"""

_REFUSAL = """\
Some settings do not fit, alone or together. Each is answered by one line that says what would
be right, and exit code 2."""

_REFUSED = (
    ("ppo.num_env=256",),
    ("ppo.num_envs=none",),
    ("ppo.num_envs=0",),
    ("ppo.discounting=1.5",),
    ("ppo.batch_size=100",),
    ("checkpoint_interval=1000",),
    ("physics.sim_dt=0.005",),
    ("ppo.learning_rate_schedule=ADAPTIVE_KL", "ppo.learning_rate=0.1"),
    ("task.success_radius=0.01",),
    ("task.options.pillar=[1, 2]",),
    ("randomization.friction=[1.2, 0.4]",),
    ("randomization.action_delay=[0, 1.5]",),
    ("trainer=brax", "ppo.normalizer=physical"),
    ("trainer=brax", "seeds=5"),
    ("trainer=brax", "deterministic=true"),
)
"""Settings that do not fit; the page shows the answer of `parse_config` to each."""


class Setting(NamedTuple):
    """A `Setting` holds one key of the configuration."""

    key: str
    """The key with its sections, such as `ppo.num_envs`."""
    kind: str
    default: Any
    meaning: str


class Section(NamedTuple):
    """A `Section` holds the settings of one section, without those of nested sections."""

    name: str
    """The name with those of the sections around it, such as `ppo.network`; empty at the top."""
    meaning: str
    settings: list[Setting]


def sections() -> list[Section]:
    """Return the whole configuration, section by section."""
    schema = Config.model_json_schema()
    defaults = Config().model_dump(mode="json")
    return list(_walk("", Config, schema, schema["$defs"], defaults))


def _walk(
    name: str,
    model: type[BaseModel],
    schema: Mapping[str, Any],
    shared: Mapping[str, Any],
    defaults: Mapping[str, Any],
) -> Iterator[Section]:
    settings, below, meanings = [], [], _meanings(model)
    for key, value in schema["properties"].items():
        path = f"{name}.{key}".lstrip(".")
        field = model.model_fields[key]
        if path == "robot":
            # One that is a model of its own is a table of its page.
            below.append((path, RobotConfig, shared["RobotConfig"], shared, defaults[key]))
        elif "$ref" in value:
            inner = shared[value["$ref"].rpartition("/")[2]]
            below.append((path, field.annotation, inner, shared, defaults[key]))
        else:
            meaning = meanings[key]
            kind = _range(value) or _kind(value, list(dict.fromkeys(_bounds(field))))
            settings.append(Setting(path, kind, defaults[key], meaning))
    yield Section(name, " ".join(schema["description"].split()), settings)
    for arguments in below:
        yield from _walk(*arguments)


def _meanings(model: type) -> dict[str, str]:
    """Return the docstrings of a section's settings, which pydantic would read at every start."""
    if model is RandomizationConfig:
        return _meanings(RobotParams) | _meanings(LookParams)
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(model))).body
    assert isinstance(tree, ast.ClassDef)
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(tree.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


def _ranges_in(name: str, table: type) -> Iterator[str]:
    """Yield the lines of a table of quantities with the ranges of a shipped configuration."""
    drawn = load_config(ROOT / "configs" / f"{name}.yaml").randomization.drawn
    yield f"| key | meaning | range in `{name}` | source |"
    yield "|---|---|---|---|"
    for key, meaning in _meanings(table).items():
        shown = ", ".join(f"{end:g}" for end in drawn.get(key, ())) or "-"
        shown = shown.replace("3.1416", "π")
        yield f"| `{key}` | {meaning} | {shown} | {QUANTITIES[key].bounds.source} |"


def _robustness_values() -> Iterator[str]:
    """Yield the lines of a table of the values at which `--robustness` evaluates a policy."""
    yield "| field | parameter | unit | values | source of the range |"
    yield "|---|---|---|---|---|"
    for name, one in QUANTITIES.items():
        values = ", ".join(f"{value:g}" for value in one.evaluated.values)
        cells = (f"`{name}`", one.evaluated.label, one.evaluated.unit, values, one.bounds.source)
        yield f"| {' | '.join(cells)} |"


def _primitives() -> Iterator[str]:
    """Yield the lines of a table of JAX's primitives that a kernel can do."""
    yield "| becomes | JAX's primitives |"
    yield "|---|---|"
    for kind, names in primitives().items():
        yield f"| {kind} | {' '.join(f'`{name}`' for name in names)} |"


def _own_model() -> Iterator[str]:
    """Yield the lines of a table of the settings of a robot that is a model of its own."""
    yield "| key | default | meaning |"
    yield "|---|---|---|"
    meanings = _meanings(MjcfRobotConfig)
    for key, field in MjcfRobotConfig.model_fields.items():
        default = "-" if field.is_required() else f"`{as_yaml(field.get_default())}`"
        yield f"| `{key}` | {default} | {meanings[key]} |"


_TABLES = {
    "own_model": _own_model,
    "robot_ranges": lambda: _ranges_in("real_jetbot", RobotParams),
    "look_ranges": lambda: _ranges_in("camera_real", LookParams),
    "robustness_values": _robustness_values,
    "primitives": _primitives,
}


_PARTS = {"Caster": Caster}
"""Sections that are items of lists."""


def with_tables(text: str) -> str:
    """Return the Markdown of a page with its tables in place of their names."""
    return re.sub(r"<!-- table: (\w+) -->", lambda found: "\n".join(_TABLES[found[1]]()), text)


def _kind(schema: Mapping[str, Any], bounds: Sequence[str]) -> str:
    """Return a type and its bounds in words."""
    if "anyOf" in schema:
        return ", or ".join(_kind(one, bounds) for one in schema["anyOf"])
    if "$ref" in schema:
        part = schema["$ref"].rpartition("/")[2]
        if part == "JsonValue":
            return "any value"
        return f"section with {', '.join(_PARTS[part].model_fields)}"
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    match schema["type"]:
        case "array" if "prefixItems" in schema:
            # The bounds are those of single items: the meaning says them.
            return f"list of {len(schema['prefixItems'])} {_kind(schema['prefixItems'][0], ())}s"
        case "array":
            inner = _kind(schema["items"], bounds)
            least = f" of at least {schema['minItems']}" if "minItems" in schema else ""
            return f"list{least}; each a {inner}"
        case "object":
            return f"keys of your own; each {_kind(schema['additionalProperties'], bounds)}"
        case "null":
            return "`null`"
        case "boolean":
            return "`true` or `false`"
        case "string":
            return "text"
        case "integer" | "number" as kind:
            words = {"integer": "whole number", "number": "number"}[kind]
            return ", ".join([words, *bounds])
        case other:
            raise ValueError(f"{other}: teach this page to say it")


def _range(schema: Mapping[str, Any]) -> str | None:
    """Return a range [low, high] in words, or None if the setting is not a range."""
    if not {"low", "high", "whole"} <= schema.keys():
        return None
    numbers = "whole numbers" if schema["whole"] else "numbers"
    return f"[low, high], {numbers} from {schema['low']:g} to {schema['high']:g}, or `null`"


def _bounds(annotated: Any) -> Iterator[str]:
    """Yield the bounds of the numbers in a type; the schema lacks those behind a validator."""
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    for one in getattr(annotated, "metadata", getattr(annotated, "__metadata__", ())):
        for name, word in words.items():
            value = getattr(one, name, None)
            if value is not None:
                yield f"{word} {_bound(value)}"
        if isinstance(one, FieldInfo):
            yield from _bounds(one)
    for part in get_args(getattr(annotated, "annotation", annotated)):
        yield from _bounds(part)


def _bound(value: float) -> str:
    if value > 2**16 and math.log2(value).is_integer():
        return f"2^{math.log2(value):.0f}^"
    return f"{value:g}"


def as_yaml(value: Any) -> str:
    """Return a value as it is written in YAML."""
    match value:
        case int() if not isinstance(value, bool):
            return f"{value:_}" if value >= 10_000 else str(value)
        case str():
            return value
        case _:
            return json.dumps(value)


def _default(value: Any) -> str:
    """Return the value, and the round number that it stands for."""
    text = f"`{as_yaml(value)}`"
    if value == math.pi:
        return f"{text} (π)"
    if isinstance(value, float) and len(repr(value)) > 10:
        return f"{text} ({Fraction(value).limit_denominator(1000)})"
    return text


def _table(section: Section) -> Iterator[str]:
    yield "| key | type and bounds | default | meaning |"
    yield "|---|---|---|---|"
    for one in section.settings:
        mark = " ↻" if one.key in CHANGEABLE_ON_RESUME else ""
        yield f"| `{one.key}`{mark} | {one.kind} | {_default(one.default)} | {one.meaning} |"


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _shipped() -> Iterator[str]:
    """Yield the lines of a table of the values in the files of `configs/`, as written there."""
    files = sorted((ROOT / "configs").glob("*.yaml"))
    said = []
    for path in files:
        load_config(path)
        said.append(dict(_leaves(YAML(typ="safe", pure=True).load(path))))
    yield "| key | " + " | ".join(f"`{path.stem}`" for path in files) + " |"
    yield "|---|" + "---|" * len(files)
    for section in sections():
        for one in section.settings:
            if any(one.key in values for values in said):
                cells = (f"`{as_yaml(v[one.key])}`" if one.key in v else "" for v in said)
                yield f"| `{one.key}` | " + " | ".join(cells) + " |"


def _refusals() -> Iterator[str]:
    """Yield the lines of a table of settings that do not fit, with the answers to them."""
    yield "| settings | answer |"
    yield "|---|---|"
    for overrides in _REFUSED:
        values: dict[str, Any] = {}
        for override in overrides:
            key, _, text = override.partition("=")
            *above, last = key.split(".")
            place = values
            for name in above:
                place = place.setdefault(name, {})
            place[last] = YAML(typ="safe", pure=True).load(text)
        try:
            parse_config(values)
        except ConfigError as error:
            settings = "<br>".join(f"`{override}`" for override in overrides)
            yield f"| {settings} | `{str(error).removeprefix('config: ')}` |"
        else:
            raise ValueError(f"{overrides} fits: take it from the list of what is refused")


def page() -> str:
    """Return the whole page as Markdown."""
    lines = [_INTRODUCTION]
    for section in sections():
        title = f"`{section.name}`" if section.name else "Top level"
        anchor = section.name.replace(".", "-") or "top"
        lines += [f"## {title} {{ #{anchor} }}", "", section.meaning, "", *_table(section), ""]
    lines += ["## The shipped files { #shipped }", ""]
    lines += ["A blank cell means the default.", "", *_shipped(), ""]
    lines += ["## Refused settings { #refused }", ""]
    lines += [_REFUSAL, "", *_refusals(), ""]
    return "\n".join(lines)


def generated() -> dict[str, str]:
    """Return the generated pages by their paths, without the reference of the rooms."""
    return {PAGE: page(), CONTRIBUTING: contributing()}


def contributing() -> str:
    """Return `CONTRIBUTING.md` with links as they are from a page of the site."""
    return (ROOT / "CONTRIBUTING.md").read_text("utf-8").replace("](docs/", "](")


class Room(NamedTuple):
    """A `Room` holds the reference of a package, of which each part is a page."""

    name: str
    face: Path
    """Its `__init__.py`."""
    parts: Mapping[str, list[str]]
    """Names of modules by the page that they are on: a page for each module with public names, for
    the others in a folder, and for the rest."""

    @property
    def home(self) -> str:
        """Return the name of the package."""
        return ".".join(self.face.parent.relative_to(ROOT).parts)

    @property
    def pages(self) -> dict[str, str]:
        """Return the Markdown of each page by its path, that of the package first."""
        pages = {f"api/{self.name}/index.md": _room_page(self)}
        for part, modules in self.parts.items():
            pages[f"api/{self.name}/{part}.md"] = _part_page(self, part, modules)
        return pages

    @property
    def nav(self) -> list[Any]:
        """Return the entries of the navigation."""
        return [
            f"api/{self.name}/index.md",
            *({part: f"api/{self.name}/{part}.md"} for part in self.parts),
        ]

    def public(self, module: str) -> list[str]:
        """Return the names that the package exports of a module."""
        inside = re.escape(module.removeprefix(f"{self.home}."))
        stub = self.face.with_suffix(".pyi").read_text("utf-8")
        return sorted(re.findall(rf"^from \.{inside} import (\w+)", stub, re.M))


_REST = "inside"
"""The page of the modules without public names."""


def rooms() -> list[Room]:
    """Return the root of the package, its rooms in the order of their names, and the engine."""
    package = ROOT / "jetbot_mjx"
    return [
        _room("root", package / "__init__.py", inside="*.py"),
        _room("onekernel", ROOT / "onekernel" / "__init__.py"),
        *(_room(face.parent.name, face) for face in sorted(package.glob("*/__init__.py"))),
    ]


def room_pages() -> dict[str, str]:
    """Return the reference of all rooms, by the paths of its pages."""
    return {path: text for room in rooms() for path, text in room.pages.items()}


def _room(name: str, face: Path, inside: str = "**/*.py") -> Room:
    """Return a package with its modules divided into pages.

    Args:
      name: its name on the site.
      face: its `__init__.py`.
      inside: which of the modules inside belong to it.
    """
    room = Room(name, face, {})
    parts: dict[str, list[str]] = {}
    for path in sorted(face.parent.glob(inside)):
        inner = path.relative_to(face.parent).with_suffix("").parts
        if path == face:
            continue
        module = f"{room.home}.{'.'.join(inner)}".removesuffix(".__init__")
        if room.public(module):
            part = ".".join(inner).removesuffix(".__init__")
        else:
            part = inner[0] if len(inner) > 1 else _REST
        parts.setdefault(part, []).append(module)
    order = sorted(parts, key=lambda part: (part == _REST, part))
    return room._replace(parts={part: parts[part] for part in order})


def _docstring(module: str) -> tuple[str, str]:
    """Return the first sentence of a module's docstring, and the rest."""
    path = ROOT / module.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    first, _, rest = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").partition("\n\n")
    return " ".join(first.split()), rest


def _imported(home: str, names: Sequence[str]) -> str:
    lines = "".join(f"    {name},\n" for name in names)
    return f"```python\nfrom {home} import (\n{lines})\n```\n" if names else ""


def _room_page(room: Room) -> str:
    """Return the page of a room: its purpose, what it exports, and its other pages."""
    first, rest = _docstring(room.home)
    names = sorted(importlib.import_module(room.home).__all__)
    lines = [f"# `{room.home}`\n", f"{first}\n", "| page | what it has |", "|---|---|"]
    for part, modules in room.parts.items():
        public = [f"`{name}`" for module in modules for name in room.public(module)]
        text = f"{_docstring(modules[0])[0]} {', '.join(public)}"
        if part == _REST:
            inside = (f"`{module.removeprefix(f'{room.home}.')}`" for module in modules)
            text = f"Modules without public names: {', '.join(inside)}"
        cell = text.strip().replace("|", "\\|")
        lines.append(f"| [{part}]({part}.md) | {cell} |")
    return "\n".join([*lines, "", f"{rest}\n", _imported(room.home, names)])


def _part_page(room: Room, part: str, modules: Sequence[str]) -> str:
    """Return a page of the reference, with one module or several."""
    title = f"Inside `{room.home}`" if part == _REST else f"`{room.home}.{part}`"
    names = sorted({name for module in modules for name in room.public(module)})
    # The title is that of the module.
    alone = "    options:\n      show_root_heading: false\n"
    told = f"::: {modules[0]}\n{alone}" if len(modules) == 1 and part != _REST else None
    texts = [told] if told else [f"::: {module}\n" for module in modules]
    return "\n".join([f"# {title}\n", _imported(room.home, names), *texts])


def with_reference(nav: list[Any]) -> list[Any]:
    """Return the entries of the navigation, with the rooms beside the page of public names."""
    added = [{room.name: room.nav} for room in rooms()]
    return [
        {title: [*pages, *added] if API in map(_only, pages) else pages}
        if isinstance(pages, list)
        else {title: pages}
        for entry in nav
        for title, pages in entry.items()
    ]


def _only(entry: Any) -> Any:
    """Return the page of an entry of the navigation, or the entry itself."""
    return next(iter(entry.values())) if isinstance(entry, dict) else entry


def on_config(config: Any) -> Any:
    """Add the generated reference to the navigation; MkDocs calls this."""
    config["nav"] = with_reference(config["nav"])
    return config


def on_files(files: Any, *, config: Any) -> Any:
    """Add the generated pages to the files of the site; MkDocs calls this."""
    from mkdocs.structure.files import File

    for name, text in {**generated(), **room_pages()}.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the tables into a page; MkDocs calls this."""
    return with_tables(markdown)


def on_post_build(*, config: Any) -> None:
    """Write the pages as Markdown beside their HTML; MkDocs calls this."""
    docs, site = Path(__file__).parent, Path(config["site_dir"])
    for path in docs.rglob("*.md"):
        text = with_tables(path.read_text("utf-8"))
        (site / path.relative_to(docs)).write_text(text, encoding="utf-8")
    for name, text in generated().items():
        (site / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    print(page())
