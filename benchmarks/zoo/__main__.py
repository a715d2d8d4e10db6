"""Updates random structures whose truth is known, and counts how that ends.

    python -m benchmarks.zoo [--runs 300] [--seed 1] [--families chain tower] [--kinds exact noisy]

A twin's truth lies within the bounds of its parameters; `benchmarks/zoo/twins.py` tells the kinds.
A line a family, and one a kind, tells how many

    truth           came to the truth: to 0.1 %, noisy ones and those of a fault within four
                    standard errors
    listed          came to it, or list it among other minima or within a valley
    verdict right   were trusted with reason or not trusted at all, and, where neither test nor
                    model has a fault, not accused of model-form error
    wrongly trusted were trusted elsewhere
    false alarms    were accused of model-form error without reason
    trusted         were trusted, wherever they ended
    and off         of these, have a parameter more than three standard errors from the truth
    lost            lost a mode or their solver
    refused         were refused with a reason
    faults          ended in exceptions that are not modetune's own

The last line is all of it as JSON.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.zoo.families import FAMILIES
from benchmarks.zoo.several_minima import far_truth
from benchmarks.zoo.structure import Structure
from benchmarks.zoo.twins import KINDS, SOUND, Kind, lacking_mass, measured

import modetune
from modetune.configs.measuring import signed
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import Floats, ModeSet
from modetune.core.storage.campaign_record import CampaignRecord

#: Of 22 twins of a family so many are of each kind.
SHARES: dict[Kind, int] = {
    "exact": 6,
    "far": 2,
    "noisy": 4,
    "missing": 2,
    "swapped": 2,
    "turned": 2,
    "reversed": 2,
    "other": 2,
}
#: An exact test is right to some eight digits; parameters that it tells a hundred times less than
#: others are exact to the fifth where frequencies are to the seventh.
E1 = 1e-7
#: An exact twin's parameters are found where they are within this of the truth.
FOUND = 1e-3
#: ... and a noisy one's within so many standard errors.
SURE = 4.0
#: Standard errors to both sides of a 95 % interval.
INTERVAL = 1.96
#: A trusted answer is off where a parameter is more standard errors from the truth.
OFF = 3.0
COLUMNS = (
    "twins",
    "truth",
    "listed",
    "verdict right",
    "wrongly trusted",
    "false alarms",
    "trusted",
    "and off",
    "lost",
    "refused",
    "faults",
    "withheld",
    "intervals",
    "with truth",
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one update ended.

    apart: largest distance of a parameter from the truth, relative; off: whether one is more than
    three standard errors away; withheld: whether standard errors are; intervals, with_truth:
    number of printed 95 % intervals, and of those with the truth.
    """

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
    listed: bool = False
    withheld: bool = False
    intervals: int = 0
    with_truth: int = 0
    off: bool = False

    @property
    def false_alarm(self) -> bool:
        return self.accused and self.kind in SOUND

    @property
    def right(self) -> bool:
        """Whether it ended with a verdict that holds."""
        return self.ended == "ended" and not self.false_alarm and (self.found or not self.trusted)


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
            "update": {"e1": {"frequency": E1, "mac": 0.9}},
            "report": {"page": False},
            "run": {"parallel": 1, "threads": 1},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )


def truth_of(structure: Structure, truth: dict[str, float], folder: Path) -> tuple[ModeSet, Floats]:
    """The modes of the true structure at its sensors, and where these are, (n_sensors, 3)."""
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
    places = np.zeros((len(structure.sensors), 3))
    if structure.solver != "matrices":
        mesh = campaign.case.solver.deck.mesh()
        places = mesh.coordinates[mesh.rows(np.array(structure.sensors))]
    return signed(elastic.rows(there).select(range(structure.n_modes))), places


def _mass(structure: Structure, truth: dict[str, float], folder: Path) -> float:
    """The model's mass; NaN for matrices."""
    asked = {"frequencies_hz": np.arange(1.0, structure.n_modes + 1.0)}
    return modetune.modes(campaign_of(structure, asked, folder), truth).mass


def _components(structure: Structure) -> str:
    assert isinstance(structure.deck, dict)
    return "xy" if "dofs" in structure.deck else "x"


def update_twin(family: str, seed: int, kind: Kind) -> Outcome:
    """One twin of one structure, updated from the deck's values."""
    rng = np.random.default_rng([seed, *family.encode()])
    structure = FAMILIES[family](rng)
    names = [item["name"] for item in structure.parameters]
    truth = structure.truth or (
        far_truth(rng, names)
        if kind == "far"
        else {item: float(rng.uniform(0.75, 1.3)) for item in names}
    )
    given = family, seed, kind
    with tempfile.TemporaryDirectory(prefix="zoo-") as name:
        folder = Path(name)
        try:
            there = folder / "true"
            there.mkdir()
            real = structure
            if kind == "other":
                real = lacking_mass(structure, _mass(structure, truth, there), rng)
            modes, places = truth_of(real, truth, there)
            test = measured(modes, places, structure, kind, rng, folder)
            campaign = campaign_of(structure, test, folder)
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
    exact = kind in SOUND - {"noisy"}
    near = FOUND * wanted if exact else SURE * record.standard_errors
    found = bool((np.abs(record.updated - wanted) <= near).all())
    told = run.summary
    printed = np.isfinite(record.standard_errors) & (record.standard_errors > 0.0)
    sigmas = np.abs(record.updated - wanted)[printed] / record.standard_errors[printed]
    return Outcome(
        *given,
        found,
        (told["trust"] or {}).get("verdict") == "trusted",
        (told["model_form"] or {}).get("suspected") is True,
        "ended",
        float(apart.max()),
        record.runs.modal,
        f"{record.status}: {record.reason}",
        found or _listed(record, wanted, near),
        record.trust is not None and record.trust.withheld,
        int(printed.sum()),
        int((sigmas <= INTERVAL).sum()),
        bool((sigmas > OFF).any()),
    )


def _listed(record: CampaignRecord, wanted: Floats, near: Floats) -> bool:
    """Whether other minima, or the valley of the answer, hold the truth; near: (n_parameters,)."""
    spread = None if record.trust is None else record.trust.spread
    if spread is None:
        return False
    rivals = [spread.updated[spread.lowest(number)] for number in spread.rivals]
    if any((np.abs(place - wanted) <= near).all() for place in rivals):
        return True
    low, high = spread.extent
    return bool(spread.valley and (low - near <= wanted).all() and (wanted <= high + near).all())


def table(outcomes: list[Outcome]) -> str:
    """A line a family, a line a kind, and one of all."""
    lines = [f"{'':18}" + "".join(f"{head:>17}" for head in COLUMNS)]
    groups = [(name, "family") for name in dict.fromkeys(item.family for item in outcomes)]
    groups += [(name, "kind") for name in dict.fromkeys(item.kind for item in outcomes)]
    for name, of in groups:
        lines.append(_line(name, [item for item in outcomes if getattr(item, of) == name]))
    return "\n".join([*lines, _line("all", outcomes)])


def _line(name: str, own: list[Outcome]) -> str:
    ended = Counter(item.ended for item in own)
    counts = (
        len(own),
        sum(item.found for item in own),
        sum(item.listed for item in own),
        sum(item.right for item in own),
        sum(item.trusted and not item.found for item in own),
        sum(item.false_alarm for item in own),
        sum(item.trusted for item in own),
        sum(item.trusted and item.off for item in own),
        ended["lost"],
        ended["refused"],
        ended["fault"],
        sum(item.withheld for item in own),
        sum(item.intervals for item in own),
        sum(item.with_truth for item in own),
    )
    return f"{name:18}" + "".join(f"{count:17d}" for count in counts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=300, help="updates in all")
    parser.add_argument("--seed", type=int, default=1, help="of the first structure of a family")
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=np.inf, help="what is done by then counts")
    asked = parser.parse_args()
    each = asked.runs / (len(asked.families) * sum(SHARES[kind] for kind in asked.kinds))
    twins = [
        (family, asked.seed + place, kind)
        for kind in asked.kinds
        for place in range(max(1, round(each * SHARES[kind])))
        for family in asked.families
    ]
    outcomes, began = [], time.monotonic()
    with ProcessPoolExecutor(
        asked.workers, initializer=logging.disable, initargs=(logging.WARNING,)
    ) as pool:
        for outcome in pool.map(update_twin, *zip(*twins, strict=True)):
            outcomes.append(outcome)
            if time.monotonic() - began > 60.0 * asked.minutes:
                pool.shutdown(wait=False, cancel_futures=True)
                break
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
