"""Pages of the documentation that follow from the program: keys, commands, the JSON schema.

    python tools/reference_pages.py            writes them into docs/
    python tools/reference_pages.py --check    lists those that are out of date

Texts come from the docstrings of `flows/campaign/schema` and of the commands; a key's unit is in
square brackets at the end of its docstring.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import typer

from modetune.flows.campaign.schema import campaign_schema, schema_text
from modetune.flows.cli.main import app

DOCS = Path(__file__).resolve().parents[1] / "docs"
MADE = "<!-- Made by tools/reference_pages.py (`make docs`); change the docstrings instead. -->\n"
#: Placeholders for the values of options.
WORDS = {Path: "PATH", int: "INTEGER", float: "NUMBER"}
UNIT = re.compile(r"^(.*?)\s*\[([^\[\]]+)\]$", re.DOTALL)
KEYS_HEAD = f"""{MADE}
# Campaign keys

All keys of the campaign file; [the campaign file](campaign.md) explains them by topic. A key
without a default is required, unless an alternative replaces it. The JSON schema for editors,
[campaign.schema.json](campaign.schema.json), has the same keys; it comes from
`modetune files schema --out campaign.schema.json`. With this first line in a campaign, VS Code with
its YAML extension completes keys and marks mistakes:

```yaml
# yaml-language-server: $schema=campaign.schema.json
```
"""
COMMANDS_HEAD = f"""{MADE}
# Commands

`modetune --help` lists the commands of a normal day, the studies, and four groups of further
commands; `modetune GROUP --help` and `modetune COMMAND --help` describe one. Each command and its
options are also below.

```
# A normal day
modetune go deck.bdf lab.unv       # all of the next: init, identify, check, update, report
modetune init deck.bdf lab.unv     # draft a campaign file for a deck and a test
modetune identify lab.unv --out modes.csv    # identify modes from response functions
modetune sensors campaign.yaml     # find the node and direction of each sensor
modetune check campaign.yaml       # report every problem, then compare model and test
modetune update campaign.yaml      # update the model; --dry-run lists the jobs without running them
modetune receive campaign.yaml lab # update with each new test that arrives in a folder
modetune history campaign.yaml     # the runs of a structure over time, and whether it changed
modetune fleet runs                # the newest run of many structures, worst first
modetune validate campaign.yaml --leave-one-out    # predict the modes that were not used
modetune view campaign.yaml        # follow the campaign in a browser
modetune report runs/garteur       # write the report again, or its figures as PNG or SVG
# Studies
modetune pretest campaign.yaml     # choose sensor and exciter positions before the test
modetune modes deck.bdf            # compute frequencies, rigid-body modes and mass of a deck
modetune correlate campaign.yaml   # compare models, tests and runs: pairs, MAC, COMAC
modetune screen campaign.yaml      # choose parameters among many candidates
modetune localise campaign.yaml    # locate modelling errors
modetune confirm runs/garteur      # let the solver confirm an answer that it has not yet
modetune compare a.yaml b.yaml     # which of several models explains a test best
modetune sample campaign.yaml      # sample the posterior of the parameters
modetune scatter campaign.yaml     # estimate how parameters vary among repeated tests
modetune check campaign.yaml --against campaign.h5     # reject a change that makes the deck worse
# The model's matrices and solvers
modetune model expand campaign.yaml          # expand measured shapes to the whole mesh
modetune model reduce deck.bdf               # condense a model for other programs
modetune model direct model.yaml test.csv    # correct stiffness and mass matrices directly
modetune model twin campaign.yaml            # compare the same model on several solvers
# Files
modetune files inspect lab.unv               # list the contents of a test file, or convert it
modetune files paraview runs/garteur         # write modes before and after updating for ParaView
modetune files schema                        # print the JSON schema of campaign files
# Unattended runs
modetune server deploy campaign.yaml         # put a study on a Prefect server, with a schedule
modetune server serve campaign.yaml          # deploy a study and run it in this process
modetune server worker                       # run deployed campaigns on this machine
modetune server status                       # show the Prefect server that commands share
modetune server prune --older 30d            # remove old runs from its database
modetune server stop                         # stop that server
# The store of results
modetune store list                # list the stored results of solver jobs
modetune store explain KEY         # describe a job and its outcome
modetune store size                # show what takes space
modetune store check               # find damaged results
modetune store prune --older 30d   # remove results by age and size
modetune store forget KEY          # remove the result of one job
# After a new version
modetune upgrade                   # rewrite records, histories and stores of earlier formats
# This installation
modetune doctor                    # test the installation and its solvers
modetune demo                      # run a complete example whose answer is known
```

Every command ends with one of these exit codes ([causes and remedies](errors.md)):

| exit code | meaning |
| --- | --- |
| 0 | done; for `update`: converged |
| 2 | bad input: the command line, the campaign, the model or the test data |
| 3 | finished, but e1 is not met, or a check left its band |
| 4 | the solver failed, or the modes do not allow the request |
| 5 | the store or the record cannot be used |
| 6 | e1 is met, but `--fail-on` excludes the [verdict](trust.md#the-verdict) |
| 7 | e1 is met, but the structure [changed](monitoring.md#the-state-of-a-structure) (`--fail-on`) |
| 70 | a fault in modetune; the message names a file to send with a report |
| 130 | stopped by the user (Ctrl-C, SIGTERM) |

Code 3 precedes 6 and 7: an update that does not meet e1 ends with 3 whatever its verdict.

With `--json`, standard output is always one JSON object, after a failure with `status`, `reason`
and `exit_code`. Progress and messages go to standard error.
"""


@dataclass(frozen=True, slots=True)
class Key:
    """A campaign key: its place, what it may be, and its meaning."""

    place: str
    kind: str
    unit: str
    default: str
    meaning: str

    def row(self) -> str:
        cells = (f"`{self.place}`", self.kind, self.unit, self.default, self.meaning)
        return "| " + " | ".join(cells) + " |"


def keys_page() -> str:
    """The page of campaign keys."""
    schema = campaign_schema()
    plain = [key for key in _keys(schema, schema, "") if "." not in key.place]
    parts = [KEYS_HEAD, _table([key for key in plain if key.kind])]
    for name, described in schema["properties"].items():
        section, many = _section(schema, described)
        if section is None:
            continue
        inner = list(_keys(schema, section, f"{name}[]." if many else f"{name}."))
        parts.append(f"## {name}\n\n{_sentence(section['description'])}\n")
        parts.append(_table([key for key in inner if key.kind]))
    return "\n".join(parts)


def _keys(schema: dict[str, Any], section: dict[str, Any], above: str) -> Iterator[Key]:
    needed = section.get("required", [])
    for name, described in section["properties"].items():
        inner, many = _section(schema, described)
        meaning = described.get("description") or (inner or {}).get("description", "")
        meaning = " ".join(meaning.split())
        unit = ""
        if found := UNIT.match(meaning):
            meaning, unit = found[1] + ".", found[2]
        default = described.get("default")
        shown = "" if default in (None, [], {}) or inner else f"`{_value(default)}`"
        if inner is None or _other_kinds(described):
            kind = _kind(described) or "text"
            yield Key(
                above + name,
                kind,
                unit,
                "required" if name in needed else shown,
                _sentence(meaning),
            )
        if inner is not None:
            yield from _keys(schema, inner, f"{above}{name}[]." if many else f"{above}{name}.")


def _value(default: Any) -> str:
    """A default as a campaign file would give it."""
    if isinstance(default, float):
        return f"{default:g}"
    return default if isinstance(default, str) else json.dumps(default)


def _section(
    schema: dict[str, Any], described: dict[str, Any]
) -> tuple[dict[str, Any] | None, bool]:
    """The section that a key holds, and whether it holds a list of them."""
    many = "items" in described and "$ref" in described["items"]
    given = [described["items"]] if many else [described, *described.get("anyOf", [])]
    for choice in given:
        if "$ref" in choice:
            return schema["$defs"][choice["$ref"].rpartition("/")[2]], many
    return None, False


def _other_kinds(described: dict[str, Any]) -> bool:
    return any(
        "$ref" not in choice and choice.get("type") != "null"
        for choice in described.get("anyOf", [])
    )


def _kind(described: dict[str, Any]) -> str:
    """What a value may be, in words."""
    if "anyOf" in described:
        kinds = list(dict.fromkeys(filter(None, map(_kind, described["anyOf"]))))
        one = " or ".join(kinds[:-1])
        return f"{one}, or a list of these" if kinds[-1] == f"list of {one}" else " or ".join(kinds)
    if "enum" in described:
        return ", ".join(f"`{value}`" for value in described["enum"])
    if "const" in described:
        return f"`{described['const']}`"
    if described.get("type") == "array":
        if "prefixItems" in described:
            return "[" + ", ".join(_kind(item) for item in described["prefixItems"]) + "]"
        return f"list of {_plural(_kind(described['items']))}"
    if described.get("type") == "object":
        if "patternProperties" in described:
            (value,) = described["patternProperties"].values()
            return f"mapping of names to {_kind(value)}"
        return f"mapping to {_kind(described['additionalProperties'])}"
    names = {"string": "text", "boolean": "`true`, `false`"}
    kind = str(described.get("type", ""))
    return (
        "" if kind == "null" or "$ref" in described else names.get(kind, kind) + _range(described)
    )


def _range(described: dict[str, Any]) -> str:
    low, above = described.get("minimum"), described.get("exclusiveMinimum")
    high, below = described.get("maximum"), described.get("exclusiveMaximum")
    lower = f" ≥ {low:g}" if low is not None else f" > {above:g}" if above is not None else ""
    upper = f" ≤ {high:g}" if high is not None else f" < {below:g}" if below is not None else ""
    return ",".join(bound for bound in (lower, upper) if bound)


def _plural(kind: str) -> str:
    return {"text": "texts", "integer": "integers"}.get(kind, kind)


def _table(keys: list[Key]) -> str:
    head = "| key | value | unit | default | meaning |\n| --- | --- | --- | --- | --- |"
    return "\n".join([head, *(key.row() for key in keys)]) + "\n"


def commands_page() -> str:
    """The page of commands, from the command line itself."""
    group: Any = typer.main.get_command(app)
    return COMMANDS_HEAD + "".join(_commands(group, "modetune"))


def _commands(group: Any, above: str) -> Iterator[str]:
    for name, command in sorted(group.commands.items()):
        if command.hidden:
            continue
        if hasattr(command, "commands"):
            yield from _commands(command, f"{above} {name}")
            continue
        given = [parameter for parameter in command.params if parameter.name != "help"]
        arguments = [p for p in given if not p.opts[0].startswith("-")]
        usage = " ".join([above, name, *(_argument(argument) for argument in arguments)])
        yield f"\n## {above} {name}\n\n{command.help}\n\n```\n{usage}\n```\n"
        if given:
            yield "\n| option | default | meaning |\n| --- | --- | --- |\n"
            yield from (_option(parameter) for parameter in given)


def _argument(argument: Any) -> str:
    name = argument.name.upper() + ("..." if argument.nargs == -1 or argument.multiple else "")
    return name if argument.required else f"[{name}]"


def _option(parameter: Any) -> str:
    named = parameter.opts[0].startswith("-")
    shown = (
        ", ".join([*parameter.opts, *parameter.secondary_opts]) if named else _argument(parameter)
    )
    if named and not parameter.is_flag:
        shown += f" {_word(parameter.type_descriptor.annotation)}"
    default = parameter.default
    if parameter.required:
        text = "required"
    elif default is None or default is False or default == [] or callable(default):
        text = ""
    else:
        text = f"`{default}`"
    return f"| `{shown}` | {text} | {_cell(parameter.help or '')} |\n"


def _word(annotation: Any) -> str:
    """Return the placeholder of an option's value."""
    while arguments := get_args(annotation):
        annotation = arguments[0]
    return WORDS.get(annotation, "TEXT")


def _sentence(text: str) -> str:
    text = _cell(" ".join(text.split()))
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def pages() -> dict[Path, str]:
    """Every page that is made, by its file."""
    return {
        DOCS / "keys.md": keys_page(),
        DOCS / "commands.md": commands_page(),
        DOCS / "campaign.schema.json": schema_text(),
    }


def stale() -> list[Path]:
    """Pages whose file is not what it would be now."""
    return [
        path
        for path, text in pages().items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]


def main() -> None:
    """Write the pages, or say which are stale."""
    if "--check" in sys.argv[1:]:
        found = stale()
        if found:
            sys.exit(f"stale: {', '.join(map(str, found))}; run python tools/reference_pages.py")
        return
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
