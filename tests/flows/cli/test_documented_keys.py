"""Every command on campaigns with every documented key: results or sentences, never a bug.

The campaigns below use all keys of docs/keys.md between them, on a bar of nine bricks and a shaft
line. Mappings have numbers as keys, which YAML reads as integers.
"""

from __future__ import annotations

import copy
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from modetune.flows.campaign.campaign import load_campaign
from tests.adapters.solved import needs_ccx
from tests.command_line import run_command
from tests.flows.updating.test_stored_matrices import BAR, written
from tests.shaft_line import shaft_frequencies, write_shaft

pytestmark = needs_ccx

ROOT = Path(__file__).resolve().parents[3]
PART: dict[str, Any] = {"deck": "part.inp", "solver": "calculix", "units": "mm-t-s"}
MODULI = [
    {"name": f"E_{place}", "quantity": "youngs_modulus", "material": f"A{place}"}
    for place in (1, 2, 3)
]
BASE: dict[str, Any] = {
    "name": "part",
    "model": PART,
    "test": {"modes": "part.csv"},
    "parameters": MODULI,
    "residuals": {"frequency_weight": 1.0, "shape_weight": 0.0},
    "update": {"max_iterations": 1, "starts": 1},
    "report": {"page": False},
}
#: Needs of a Nastran deck, or of programs that are not here; their own tests use them.
ELSEWHERE = {
    "model.dialect", "model.subcase",
    *(f"run.slurm.{key}" for key in ("partition", "account", "time", "options")),
    *(f"run.dask.{key}" for key in (
        "scheduler", "cluster", "workers", "memory", "walltime", "queue", "account", "interface",
        "directives", "prologue")),
}  # fmt: skip
CENTRES = {
    name: {"target": target, "deviation": 1.0, "weight": 0.1, "limits": [-1e3, 1e3]}
    for name, target in (("centre_x", 45.0), ("centre_y", 5.0), ("centre_z", 4.0))
}
INERTIAS = {
    f"inertia_{name}": {"target": 1.0, "deviation": 1.0, "weight": 0.1, "limits": [-1e3, 1e3]}
    for name in ("xx", "yy", "zz", "xy", "yz", "zx")
}
#: The campaigns: their own sections over those of BASE; None takes one out.
CAMPAIGNS: dict[str, dict[str, Any]] = {
    "landmarks": {
        "test": {
            "modes": ["part.csv", "points.csv"],
            "repeats": ["again.csv"],
            "environment": {"temperature_C": 21.5},
            "measured_at": "2026-11-27T02:00:00Z",
            "length": "mm",
            "axes": "auto",
            "sensors": {
                "by": "position",
                "align": "fit",
                "match": {5: 5, 40: 40, 37: 37, 19: [40.0, 10.0, 0.0]},
                "tolerance": 1.0,
                "attach": False,
                "unmapped": "leave_out",
            },
        },
        "residuals": {"sensor_weight": {5: 0.0}, "sensor_deviation": {"7.x": 0.1, 8: 0.2}},
    },
    "positions": {
        "test": {
            "modes": ["part.csv", "points.csv"],
            "sensors": {
                "align": "none",
                "scale": 1.0,
                "rotation": [0, 0, 0],
                "translation": [0, 0, 0],
                "reverse": ["12.x", 13],
                "exchange": [["20.x", "20.y"]],
                "drop": ["30.z", 31],
            },
        },
        "model": {
            **PART,
            "deck": "stepped.inp",
            "eigensolver": "mixed_precision",
            "step": 1,
            "rigid_modes": 0,
        },
        "update": {"confirm": "modes", "e1": {"frequency": 0.01, "mac": 0.5}},
        "run": {"keep_jobs": True},
    },
    "by mode": {
        "test": {
            "use": [1, 2, 4],
            "hold_out": [3, 5],
            "pairs": {1: 1, 2: 2},
            "unmatched": "drop",
            "sensors": {"by": "number"},
        },
        "residuals": {
            "frequency_weight": {1: 2.0, "others": 1.0},
            "shape_weight": {1: 0.1, 2: 0.2},
            "frequency_deviation": {1: 0.01, "others": 0.02},
            "shape_deviation": {2: 0.1, "others": 0.2},
            "mac": {"weight": {1: 1.0, 4: 0.5}, "quantity": "root", "deviation": {1: 0.1, 2: 0.2}},
        },
    },
    "other responses": {
        "model": {**PART, "deck": "free.inp"},
        "test": {"modes": "free.csv"},
        "residuals": {
            "modal_strain": {
                "gauges": ["5-9", "9-13"],
                "modes": {1: [1e-4, 2e-4], 2: [1e-4, 2e-4]},
                "scale": "own",
                "weight": 0.1,
                "deviation": 0.2,
                "tolerance": 5.0,
            },
            "mass_properties": {
                "mass": {"target": 2e-5, "deviation": 1e-6, "weight": 1.0, "limits": [0.0, 1.0]},
                **CENTRES,
                **INERTIAS,
                "within": 5.0,
            },
        },
    },
    "static": {
        "residuals": {
            "static": {
                "cases": [
                    {
                        "forces": {"40.z": 1.0},
                        "displacements": {"40.z": 1e-3, "39.z": 1e-3},
                        "strains": {"5-9": 1e-5},
                        "deviation": 0.05,
                        "tolerance": 1.0,
                        "weight": 0.1,
                    },
                    {"load": 1, "displacements": {"40.z": 1e-3}},
                ]
            },
            "damping": {"weight": {1: 1.0}, "deviation": 0.1, "tolerance": 0.5},
            "complex_shapes": {"weight": {1: 1.0}, "deviation": 0.1, "mac": 0.9},
            "frf": {
                "band": [10.0, 2e4],
                "points": 4,
                "deviation": 0.1,
                "averages": 1,
                "coherence": 0.5,
                "damping": {1: 0.01, "others": 0.02},
                "frac": 0.5,
                "weight": 0.1,
            },
        },
    },
    "configurations": {
        "model": None,
        "test": None,
        "configurations": [
            {
                "name": "one",
                "model": PART,
                "test": {"modes": "part.csv"},
                "residuals": {"frequency_weight": {1: 1.0, "others": 0.5}},
                "weight": 2.0,
            },
            {
                "name": "2",
                "model": PART,
                "test": {"modes": "part.csv", "use": [1, 2], "pairs": {1: 1}},
                "hold_out": False,
            },
        ],
        "parameters": [
            {**MODULI[0], "configurations": ["one", "2"]},
            {**MODULI[1], "material": ["A2"]},
            {**MODULI[2], "expression": "E_2 * ratio"},
            {
                "name": "ratio",
                "quantity": "variable",
                "values": "absolute",
                "bounds": [0.5, 2.0],
                "initial": 1.0,
                "deviation": 0.1,
            },
        ],
    },
    "field": {
        "parameters": [
            {
                "name": "E",
                "quantity": "youngs_modulus",
                "elset": "V",
                "field": {"zones": 3, "smoothing": "neighbours", "length": 2.0},
            }
        ],
    },
    "numbers as names": {
        "parameters": [
            {**MODULI[0], "material": None, "element": [1, 2, 3], "item": 0},
            {**MODULI[1], "name": "5"},
            {"name": "7", "quantity": "density", "elset": "V3", "bounds": [0.5, 2.0]},
        ],
        "model": {**PART, "checks": ["units", "size", "mass", "mesh"]},
        "update": {
            "start": "last",
            "seed": 3,
            "step": "regularised",
            "regularisation": "l_curve",
            "e2": 0.1,
            "step_limit": 0.3,
        },
        "sensitivity": {
            "method": "finite_difference",
            "between": "keep",
            "difference": "central",
            "step": 0.02,
        },
        "report": {"page": True, "nodes": 100},
        "run": {
            "parallel": 1,
            "threads": 1,
            "licences": {"calculix": 2},
            "licence_messages": ["no token"],
            "disk_gb": 1.0,
            "memory_gb": 4.0,
            "engine": "local",
            "prefect": False,
            "fail_on": "never",
            "keep": 2,
            "retries": {"stopped": 1, "timeout": 1, "no_result": 0},
            "failed_column": "stop",
            "timeout_s": 100.0,
            "licence_pause_s": 1.0,
            "licence_wait_s": 10.0,
        },
        "monitoring": {
            "learning": 10,
            "reference": "2024-01-01",
            "structures": 3,
            "false_alarm_rate": 1e-4,
        },
    },
    "command": {
        "model": {
            "deck": "shaft.txt",
            "solver": "command",
            "units": "m-kg-s",
            "command": {
                "name": "shaftline",
                "run": ["{python}", "shaft.py", "{deck}"],
                "version": "2.5.1",
                "nodes": "nodes.csv",
                "components": ["rx"],
                "results": "twist.csv",
                "normalisation": "mass",
                "most_modes": 6,
                "inputs": ["shaft.py"],
                "depends": ["nodes.csv"],
                "environment": ["LANG"],
                "delimiters": ["{", "}"],
                "edits": [
                    {"parameter": "m_2", "line": 3, "field": 3},
                    {"parameter": "m_3", "line": 3, "columns": [19, 22], "format": "4.0f"},
                    {
                        "parameter": "m_4",
                        "file": "shaft.py",
                        "pattern": r"never (\S+)",
                    },
                ],
                "success": ["^END OF SHAFT"],
                "fatal": [r"\bE-\d{4}\b"],
                "logs": ["solver.log"],
                "exit_codes": [0],
            },
        },
        "test": {"modes": "measured.csv"},
        "parameters": [
            {"name": "k_engine", "quantity": "spring_stiffness"},
            {"name": "k_shaft", "quantity": "spring_stiffness"},
            {"name": "propeller", "quantity": "number"},
        ],
    },
}
#: Campaigns that are refused, in a sentence, by what the bar cannot have: a test of damping,
#: complex shapes and response functions, a deck with a load, a number that is not there.
REFUSED = ("static", "command")
#: The commands, with the campaign and its run folder in place of CAMPAIGN and RUN.
COMMANDS = [
    line.split()
    for line in """
sensors CAMPAIGN
check CAMPAIGN
pretest CAMPAIGN
modes CAMPAIGN
correlate CAMPAIGN
update CAMPAIGN --dry-run
screen CAMPAIGN --method local --out proposed/campaign.yaml
localise CAMPAIGN --no-changes
update CAMPAIGN
update CAMPAIGN --json
report RUN
correlate RUN
check CAMPAIGN --against RUN
history CAMPAIGN
fleet CAMPAIGN
sample CAMPAIGN --points 8 --steps 100 --checks 0
scatter CAMPAIGN --points 8
validate CAMPAIGN
compare CAMPAIGN OTHER
model expand CAMPAIGN
model reduce CAMPAIGN
model direct CAMPAIGN
model twin CAMPAIGN --solvers calculix,command
files inspect CAMPAIGN
""".splitlines()
    if line
]


#: Commands that solve much, and the campaigns with most integer keys, which they run on.
SLOW = ("sample", "compare", "validate", "localise", "model")
FOR_SLOW = ("landmarks", "by mode", "configurations")


def merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    found = dict(copy.deepcopy(base))
    for key, value in own.items():
        if value is None:
            found.pop(key, None)
        elif isinstance(value, dict) and isinstance(found.get(key), dict) and key != "model":
            found[key] = merged(found[key], value)
        else:
            found[key] = copy.deepcopy(value)
    return found


def keys_of(section: object, place: str = "") -> Iterator[str]:
    """Yield keys as docs/keys.md has them: `parameters[].name`."""
    if isinstance(section, dict):
        for key, value in section.items():
            name = f"{place}.{key}" if place else str(key)
            yield name
            yield from keys_of(value, name)
    elif isinstance(section, list):
        for value in section:
            yield from keys_of(value, f"{place}[]")


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of the bar and of the shaft line."""
    folder = written(BAR, tmp_path_factory.mktemp("keys") / "bar").parent
    deck, table = ((folder / name).read_text() for name in ("part.inp", "part.csv"))
    (folder / "stepped.inp").write_text(f"{deck}*STEP\n*FREQUENCY\n6\n*END STEP\n")
    head, *rows = table.splitlines()
    again, random = [head], np.random.default_rng(0)
    for row in rows:
        name, *values = row.split(",")
        changed = (f"{float(value) * random.normal(1.0, 0.002):.7g}" for value in values)
        again.append(",".join([name, *changed]))
    (folder / "again.csv").write_text("\n".join(again) + "\n")
    free = re.sub(r"\*BOUNDARY\n(\d.*\n)+", "", deck)
    beside = written(replace(BAR, deck=free, n_modes=12), folder.with_name("free")).parent
    shutil.copyfile(beside / "part.inp", folder / "free.inp")
    cells = [line.split(",") for line in (beside / "part.csv").read_text().splitlines()]
    elastic = [",".join([row[0], *row[7:]]) for row in cells[1:]]  # six motions of a rigid body
    (folder / "free.csv").write_text("\n".join([head, *elastic]) + "\n")
    nodes = re.findall(r"^(\d+, -?[\d.]+, -?[\d.]+, -?[\d.]+)$", deck, re.MULTILINE)
    (folder / "points.csv").write_text("\n".join(["metres,0.001", "node,x,y,z", *nodes]) + "\n")
    write_shaft(folder)
    twists = ",".join(f"{value:.12g}" for value in shaft_frequencies(k_engine=0.8)[:5])
    (folder / "measured.csv").write_text(f"mode,1,2,3,4,5\nfrequency_hz,{twists}\n")
    return folder


def test_the_campaigns_use_every_documented_key() -> None:
    rows = re.findall(r"^\| `([^`]+)` \|", (ROOT / "docs" / "keys.md").read_text(), re.MULTILINE)
    documented = {row.removeprefix("configurations[].") for row in rows}
    assert len(documented) > 150
    used = {"store"}  # by all of them below
    for own in CAMPAIGNS.values():
        used |= {key.removeprefix("configurations[].") for key in keys_of(merged(BASE, own))}
    absent = documented - used - ELSEWHERE
    choices = {"parameters[].property", "parameters[].part", "model.command.reader"}
    assert absent <= {*choices, "run.retries"}, sorted(absent)


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_no_command_ends_with_a_bug(name: str, bar: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    shutil.copytree(bar, folder, ignore=shutil.ignore_patterns("truth", "store"))
    (folder / "proposed").mkdir()
    data = merged(BASE, {**CAMPAIGNS[name], "store": str(bar / "store")})
    for file, called in (("campaign.yaml", "part"), ("other.yaml", "other")):
        text = yaml.safe_dump({**data, "name": called}, sort_keys=False)
        (folder / file).write_text(text)
    if name not in REFUSED:
        load_campaign(folder / "campaign.yaml")
    words = {"CAMPAIGN": "campaign.yaml", "OTHER": "other.yaml", "RUN": "runs/part"}
    for command in COMMANDS:
        if command[0] in SLOW and name not in FOR_SLOW:
            continue
        done = run_command(folder, *(words.get(word, word) for word in command))
        where = f"{' '.join(command)}: {done.stderr[-2000:]}"
        assert done.returncode in (0, 2, 3, 4), where
        assert done.returncode == 0 or done.stderr.strip(), where
        assert "Traceback" not in done.stderr, where
        if name not in REFUSED and command[0] in ("screen", "update"):
            assert done.returncode in (0, 3), where
        if command[0] == "screen" and done.returncode == 0:
            load_campaign(folder / "proposed" / "campaign.yaml")
        if command[0] == "sample" and done.returncode == 0:
            assert "around the end of the update in runs/part" in done.stdout
