"""Updates random structures whose truth is known, and counts how that ends.

    python -m benchmarks.zoo [--runs 300] [--seed 1] [--families chain tower] [--kinds exact noisy]

A twin's truth lies within the bounds of its parameters: `exact` is the model with these values,
`noisy` adds 0.1 % to frequencies and 3 % of their rms to shapes. A line a family tells how many
came to the truth (exact: to 0.1 %; noisy: within four standard errors), were trusted elsewhere,
were accused of model-form error, lost a mode or their solver, were refused with a reason, and how
many were faults: exceptions that are not modetune's own. The last line is all of it as JSON.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from benchmarks.zoo.structures import FAMILIES, Structure

import modetune
from modetune.configs.measuring import noisy, signed
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import COMPONENTS, ModeSet

Kind = Literal["exact", "noisy"]
KINDS: tuple[Kind, ...] = ("exact", "noisy")
FREQUENCY_NOISE, SHAPE_NOISE = 0.001, 0.03
#: An exact twin's parameters are found where they are within this of the truth.
FOUND = 1e-3
#: ... and a noisy one's within so many standard errors.
SURE = 4.0
COLUMNS = ("runs", "truth", "wrongly trusted", "form accused", "lost", "refused", "faults")


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one update ended. apart: largest distance of a parameter from the truth, relative."""

    family: str
    seed: int
    kind: Kind
    found: bool = False
    trusted: bool = False
    accused: bool = False
    ended: str = ""
    apart: float = float("nan")
    modal_runs: int = 0
    said: str = ""


def campaign_of(structure: Structure, test: dict[str, Any], folder: Path) -> modetune.Campaign:
    """A campaign at default settings, but for an end that an exact twin allows."""
    model: dict[str, Any] = {"units": "mm-t-s", "solver": structure.solver}
    if isinstance(structure.deck, str):
        nastran = structure.deck.startswith("SOL")
        deck = folder / ("model.bdf" if nastran else "model.inp")
        deck.write_text(structure.deck)
        model["deck"] = deck
    else:
        model |= structure.deck
    return modetune.load(
        {
            "name": structure.family,
            "model": model,
            "test": test,
            "parameters": [{**item, "bounds": [0.4, 2.5]} for item in structure.parameters],
            "residuals": {"shape_weight": 1.0},
            "update": {"e1": {"frequency": 1e-5, "mac": 0.9}},
            "report": {"page": False},
            "run": {"parallel": 1, "threads": 1},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )


def measured(modes: ModeSet) -> dict[str, Any]:
    names = zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
    return {
        "frequencies_hz": modes.frequencies_hz,
        "mode_shapes": modes.mode_shapes,
        "dofs": [f"{node}.{COMPONENTS[component - 1]}" for node, component in names],
    }


def truth_of(structure: Structure, truth: dict[str, float], folder: Path) -> ModeSet:
    """The modes of the true structure at its sensors."""
    components = "xyz" if structure.solver != "matrices" else _components(structure)
    dofs = [f"{node}.{axis}" for node in structure.sensors for axis in components]
    asked = {
        "frequencies_hz": np.arange(1.0, structure.n_modes + 1.0),
        "mode_shapes": np.ones((len(dofs), structure.n_modes)),
        "dofs": dofs,
    }
    campaign = campaign_of(structure, asked, folder)
    elastic = modetune.modes(campaign, truth).elastic
    there = np.flatnonzero(
        np.isin(elastic.nodes, structure.sensors) & (elastic.components <= len(components))
    )
    return signed(elastic.rows(there).select(range(structure.n_modes)))


def _components(structure: Structure) -> str:
    assert isinstance(structure.deck, dict)
    return "xy" if "dofs" in structure.deck else "x"


def update_twin(family: str, seed: int, kind: Kind) -> Outcome:
    """One twin of one structure, updated from the deck's values."""
    rng = np.random.default_rng([seed, *family.encode()])
    structure = FAMILIES[family](rng)
    truth = {item["name"]: float(rng.uniform(0.75, 1.3)) for item in structure.parameters}
    given = family, seed, kind
    with tempfile.TemporaryDirectory(prefix="zoo-") as name:
        folder = Path(name)
        try:
            modes = truth_of(structure, truth, folder)
            if kind == "noisy":
                modes = noisy(modes, FREQUENCY_NOISE, SHAPE_NOISE, seed)
            campaign = campaign_of(structure, measured(modes), folder)
            run = modetune.update(campaign, folder / "runs")
        except (CampaignError, ModelError) as error:
            return Outcome(*given, ended="refused", said=str(error))
        except modetune.ModetuneError as error:
            return Outcome(*given, ended="lost", said=str(error))
        except Exception:  # what is counted here is that there is none
            return Outcome(*given, ended="fault", said=traceback.format_exc())
        record = run.record
    wanted = np.array([truth[name] for name in record.parameters.names])
    apart = np.abs(record.updated / wanted - 1.0)
    if kind == "exact":
        found = bool((apart <= FOUND).all())
    else:
        found = bool((np.abs(record.updated - wanted) <= SURE * record.standard_errors).all())
    told = run.summary
    return Outcome(
        *given,
        found,
        (told["trust"] or {}).get("verdict") == "trusted",
        (told["model_form"] or {}).get("suspected") is True,
        "ended",
        float(apart.max()),
        record.runs.modal,
        f"{record.status}: {record.reason}",
    )


def table(outcomes: list[Outcome]) -> str:
    """A line a family and kind."""
    lines = [f"{'family':18}{'twins':8}" + "".join(f"{head:>17}" for head in COLUMNS)]
    for family, kind in dict.fromkeys((item.family, item.kind) for item in outcomes):
        own = [item for item in outcomes if (item.family, item.kind) == (family, kind)]
        ended = Counter(item.ended for item in own)
        counts = (
            len(own),
            sum(item.found for item in own),
            sum(item.trusted and not item.found for item in own),
            sum(item.accused for item in own),
            ended["lost"],
            ended["refused"],
            ended["fault"],
        )
        lines.append(f"{family:18}{kind:8}" + "".join(f"{count:17d}" for count in counts))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=300, help="updates in all")
    parser.add_argument("--seed", type=int, default=1, help="of the first structure of a family")
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    each = max(1, asked.runs // (len(asked.families) * len(asked.kinds)))
    twins = [
        (family, asked.seed + place, kind)
        for family in asked.families
        for kind in asked.kinds
        for place in range(each)
    ]
    outcomes = []
    with ProcessPoolExecutor(
        asked.workers, initializer=logging.disable, initargs=(logging.WARNING,)
    ) as pool:
        for outcome in pool.map(update_twin, *zip(*twins, strict=True)):
            outcomes.append(outcome)
            if not outcome.found:
                said = outcome.said.strip().splitlines()
                shown = said[-1] if outcome.ended == "fault" else said[0]
                sys.stderr.write(
                    f"{outcome.family} {outcome.seed} {outcome.kind}: {outcome.ended}, "
                    f"{outcome.apart:.2g} apart; {shown}\n"
                )
    sys.stdout.write(f"{table(outcomes)}\n{json.dumps([asdict(item) for item in outcomes])}\n")


if __name__ == "__main__":
    main()
