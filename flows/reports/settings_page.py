"""The page docs/reference/settings.md, generated from the steps' parameters.

After a change of a step's `Params` or its docstring:
`python -m scan2sim.flows.reports.settings_page > docs/reference/settings.md`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

from scan2sim.flows.pipelines import drive, images, tile, video
from scan2sim.pipeline.core.parameters import described
from scan2sim.pipeline.core.step import Params, Step

HEAD = """# Settings

Parameters of every step, with defaults and accepted ranges. Change one with `--set step.param=value`, for one class
with `--set step.building.param=value`, or in a TOML file given by `--config`:

```toml
[decimate]
target = 50000            # triangles, for every class

[decimate.vegetation]
target = 200000           # for this class
```

A value out of range, or a name that does not exist, is rejected before anything runs; the message gives the range or
the nearest name. Defaults marked D3.2 are the numbers of 5G-ERA D3.2, section 4.2.
"""
PARTS = (
    ("", "", tile.STEPS),
    ("A video", "Steps of `scan2sim slam` ([slam.md](../slam.md)); most settings are options of that command.",
     video.STEPS),
    ("A drive", "Steps that run before a survey's tiles ([surveys.md](../surveys.md#drives)); most settings are "
     "options of `scan2sim import sweeps` and `scan2sim tile`, or fields of `drive.toml`.", drive.STEPS),
    ("Photos without poses", "Steps of `scan2sim import images` ([images.md](../images.md)); settings are options "
     "of that command.", images.STEPS),
)  # fmt: skip
ATTRIBUTE_LINE = re.compile(r"^([a-z_0-9]+(?:, [a-z_0-9]+)*): (.*)$")


def settings_page() -> str:
    """The page as Markdown; steps without settings are left out."""
    parts = [HEAD]
    seen: set[str] = set()
    for title, about, steps in PARTS:
        if title:
            parts.append(f"# {title}\n\n{about}\n")
        new = [step for step in steps if step.name not in seen]
        seen |= {step.name for step in new}
        parts += [_section(step) for step in new if step.params.settings()]
    return "\n".join(parts)


def _section(step: Step) -> str:
    about = inspect.cleandoc(step.run.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    rows = list(_rows(step))
    table = ["", "| setting | default | range | meaning |", "| --- | --- | --- | --- |", *rows]
    return "\n".join([f"## {step.name}", "", about, *table, ""])


def _rows(step: Step) -> Iterator[str]:
    meanings = attributes(step.params)
    for name, field in step.params.settings().items():
        default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
        special = [f"{group} {_value(values[name])}" for group, values in step.class_defaults.items() if name in values]
        cells = "; ".join([default, *special]), described(field), meanings.get(name) or field.description or ""
        yield f"| `{step.name}.{name}` | " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _value(default: object) -> str:
    if default is None or default == ():
        return "not set"
    return str(default).lower() if isinstance(default, bool) else str(default)


def attributes(params: type[Params]) -> dict[str, str]:
    """Meanings of parameters by name, from the section `Attributes` of docstrings, base classes included."""
    found: dict[str, str] = {}
    for base in reversed(params.__mro__):
        section = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")[2] if issubclass(base, Params) else ""
        names: list[str] = []
        for line in inspect.cleandoc(section).splitlines() if section else ():
            match = ATTRIBUTE_LINE.match(line)
            if match:
                names = match[1].split(", ")
                found |= dict.fromkeys(names, match[2])
            elif line.startswith(" ") and names:
                found |= {name: f"{found[name]} {line.strip()}" for name in names}
            else:
                break
    return found


if __name__ == "__main__":
    print(settings_page(), end="")
