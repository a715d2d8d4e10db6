"""How often `modetune localise` proposes what a model really lacks.

    python -m benchmarks.proposals [--runs 100] [--seed 1] [--kinds mass none] [--to FILE]

Each twin is a structure of the zoo whose true model, solved by its own program, has one change that
the campaign does not know; its test has 0.2 % of noise on frequencies and 5 % on shapes.

    mass       a point mass of 1 to 20 % of the model's at a random node
    spring     a spring to the ground at a random node, of a stiffness like the place's own
    clamp      supports that yield: springs in place of all of them, or of one rotation of a stick
    softened   a material whose modulus is 0.5 to 0.8 or 1.25 to 2 times what the campaign, which
               does not update it, takes
    none       nothing

The noncentrality is the misfit that the campaign's parameters leave of a test without noise. A
proposal is right if it is of the kind and at the nearest of the places that were tried, or if with
that test it leaves a misfit below 9: then no test of this noise tells it from the truth.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.zoo.__main__ import truth_of
from benchmarks.zoo.families import FAMILIES
from benchmarks.zoo.structure import Generator, Structure
from threadpoolctl import threadpool_limits

import modetune
from modetune.configs.measuring import noisy
from modetune.core.modes import COMPONENTS, Floats, ModeSet
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.studies.localise.proposals import ChangeSearch, search_of
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.mode_source import Demand

FREQUENCY_NOISE, SHAPE_NOISE = 0.002, 0.05
KINDS = ("mass", "spring", "clamp", "softened", "none")
#: Frames, shells, solids from a mesher, sticks of a Nastran deck, and matrices.
OF = ("tower", "grillage", "stiffened_plate", "tube", "bracket", "soft_mounts", "stick", "chain")
#: Kinds of changes that stand for the hidden one.
NAMES = {
    "mass": "point mass",
    "spring": "spring to ground",
    "clamp": "yielding support",
    "softened": "group",
}
#: Families whose supports can yield, and N/mm or N mm of a spring that then holds them.
CLAMPED = {"bracket": (1e3, 1e5), "stick": (1e7, 1e9)}
#: Smaller effects cannot be seen; a smaller difference of misfits cannot be told apart.
SEEN, ALIKE = 25.0, 9.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was proposed for one twin. rank: of the first right change, 0 where none is."""

    family: str
    seed: int
    kind: str
    hidden: str = ""
    noncentrality: float = float("nan")
    rank: int = 0
    proposed: bool = False
    first: str = ""
    value: float = float("nan")
    changes: int = 0
    runs: int = 0
    seconds: float = float("nan")
    failed: str = ""


@dataclass(frozen=True, slots=True)
class Hidden:
    """A structure with a change, and what it is."""

    structure: Structure
    about: str
    node: int = 0
    component: int = 0
    material: str = ""


def hidden_change(structure: Structure, kind: str, rng: Generator, mass: float) -> Hidden:
    """Return the true structure. mass: of the model, of one unknown for matrices."""
    deck = structure.deck
    if kind == "none":
        return Hidden(structure, "nothing")
    if kind == "softened":
        last = structure.parameters[-1]
        return Hidden(structure, f"{last['name']}", material=str(last["material"]))
    if kind == "clamp":
        return _yielding(structure, rng)
    node = int(rng.choice(structure.sensors))
    if isinstance(deck, dict):
        added = np.array(deck["mass" if kind == "mass" else "stiffness"], dtype=np.float64)
        place = node - 1
        added[place, place] += float(rng.uniform(0.05, 0.5)) * added[place, place]
        return Hidden(
            replace(structure, deck={**deck, "mass" if kind == "mass" else "stiffness": added}),
            f"{kind} at {node}", node, 1,
        )  # fmt: skip
    value = float(np.exp(rng.uniform(np.log(0.01), np.log(0.2)))) * mass
    component = int(rng.integers(1, 4))
    if deck.startswith("SOL"):
        cards = f"CONM2,999999,{node},,{value:.6g}\n"
        if kind == "spring":
            value = float(np.exp(rng.uniform(np.log(1.0), np.log(300.0))))
            cards = f"CELAS2,999999,{value:.6g},{node},{component}\n"
        text = deck.replace("ENDDATA", f"{cards}ENDDATA")
    else:
        cards = f"*ELEMENT, TYPE=MASS, ELSET=HIDDEN\n999999, {node}\n*MASS, ELSET=HIDDEN\n"
        if kind == "spring":
            value = float(np.exp(rng.uniform(np.log(1.0), np.log(300.0))))
            cards = f"*ELEMENT, TYPE=SPRING1, ELSET=HIDDEN\n999999, {node}\n"
            cards += f"*SPRING, ELSET=HIDDEN\n{component}\n"
        cards += f"{value:.6e}\n"
        before, step, after = deck.partition("*STEP")
        text = before + cards + step + after
    about = f"{kind} {value:.4g} at {node}" + (f".{component}" if kind == "spring" else "")
    return Hidden(replace(structure, deck=text), about, node, component)


def _yielding(structure: Structure, rng: Generator) -> Hidden:
    """The structure on springs, all translations of solids' nodes or one rotation of a stick."""
    deck = str(structure.deck)
    low, high = np.log(CLAMPED[structure.family])
    value = f"{np.exp(rng.uniform(low, high)):.6e}"  # a whole number is no stiffness for ccx
    if deck.startswith("SOL"):
        component = int(rng.choice((5, 6)))
        others = "123456".replace(str(component), "")
        spring = f"CELAS2,999999,{value},1,{component}\n"
        deck = deck.replace("SPC1,1,123456,1", f"SPC1,1,{others},1\n{spring.strip()}")
        return Hidden(
            replace(structure, deck=deck), f"spring {value} at 1.{component}", 1, component
        )
    before, _, rest = deck.partition("*BOUNDARY\n")
    held, after = [], rest.splitlines(keepends=True)
    while after and not after[0].startswith("*"):
        held.append(after.pop(0).split(",")[0].strip())
    springs = "".join(
        f"*ELEMENT, TYPE=SPRING1, ELSET=HIDDEN{axis}\n"
        + "".join(f"{990000 + 3 * n + axis}, {node}\n" for n, node in enumerate(held))
        + f"*SPRING, ELSET=HIDDEN{axis}\n{axis}\n{value}\n"
        for axis in (1, 2, 3)
    )
    return Hidden(
        replace(structure, deck=before + springs + "".join(after)), f"springs of {value} a node"
    )


def campaign_of(structure: Structure, test: ModeSet, folder: Path) -> Campaign:
    """A campaign that knows the noise of its test."""
    model: dict[str, Any] = {"units": "mm-t-s", "solver": structure.solver}
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(structure.deck, str):
        model["deck"] = folder / ("model.bdf" if structure.deck.startswith("SOL") else "model.inp")
        model["deck"].write_text(structure.deck)
    else:
        model |= structure.deck
    names = zip(test.nodes.tolist(), test.components.tolist(), strict=True)
    return modetune.load(
        {
            "name": structure.family,
            "model": model,
            "test": {
                "frequencies_hz": test.frequencies_hz,
                "mode_shapes": test.mode_shapes,
                "dofs": [f"{node}.{COMPONENTS[component - 1]}" for node, component in names],
                "unmatched": "drop",
            },
            "parameters": [{**item, "bounds": [0.4, 2.5]} for item in structure.parameters],
            "residuals": {
                "frequency_deviation": FREQUENCY_NOISE,
                "shape_weight": 1.0,
                "shape_deviation": SHAPE_NOISE,
            },
            "report": {"page": False},
            "run": {"parallel": 1, "threads": 1},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )


@contextmanager
def searching(campaign: Campaign, theta: Floats) -> Iterator[tuple[ChangeSearch, int]]:
    """A search on a campaign's model from these values, and the solver runs that it took."""
    with solving_engine(campaign) as engine:
        evaluator = evaluator_of(campaign, engine, demand=Demand(steps=1, matrices=True))
        evaluation, _ = evaluator.evaluate("values", theta, None, alone=True)
        search = search_of(campaign, evaluator, evaluation)
        yield search, evaluator.runs.modal + evaluator.runs.sensitivity


def try_twin(family: str, seed: int, kind: str) -> Outcome:
    """One twin."""
    rng = np.random.default_rng([seed, *family.encode(), *kind.encode()])
    structure = FAMILIES[family](rng)
    given = family, seed, kind
    names = [item["name"] for item in structure.parameters]
    truth = structure.truth or {name: float(rng.uniform(0.75, 1.3)) for name in names}
    own = structure
    if kind == "softened":
        factor = float(rng.uniform(0.5, 0.8) if rng.random() < 0.5 else rng.uniform(1.25, 2.0))
        truth = {**truth, names[-1]: factor}
        own = replace(structure, parameters=structure.parameters[:-1])
    with tempfile.TemporaryDirectory(prefix="proposals-") as name:
        folder = Path(name)
        for part in ("mass", "true"):
            (folder / part).mkdir()
        try:
            mass = _mass(structure, truth, folder / "mass")
            hidden = hidden_change(structure, kind, rng, mass)
            modes, _ = truth_of(hidden.structure, truth, folder / "true")
            known = np.array([truth[item["name"]] for item in own.parameters])
            with searching(campaign_of(own, modes, folder / "exact"), known) as (exact, _):
                noncentrality = exact.misfit
                if kind != "none" and noncentrality < SEEN:
                    return Outcome(*given, hidden.about, noncentrality, failed="too small to see")
                measured = noisy(modes, FREQUENCY_NOISE, SHAPE_NOISE, int(rng.integers(2**31)))
                campaign = campaign_of(own, measured, folder / "noisy")
                updated = modetune.update(campaign, folder / "runs").record.updated
                began = time.monotonic()
                with searching(campaign, updated) as (search, runs):
                    found = search.ranked()
                seconds = time.monotonic() - began
                rank = next(
                    (
                        place
                        for place, item in enumerate(found.found[:3], start=1)
                        if _right(item.change, hidden, kind, search, exact)
                    ),
                    0,
                )
        except modetune.ModetuneError as error:
            return Outcome(*given, failed=str(error).splitlines()[0])
        except Exception:  # counted as a fault
            return Outcome(*given, failed=traceback.format_exc())
    first = found.found[0] if found.found else None
    return Outcome(
        *given,
        hidden.about,
        noncentrality,
        rank,
        found.proposed,
        "" if first is None else first.change.label,
        float("nan") if first is None else float(first.amplitudes[0]),
        found.n_changes,
        runs,
        seconds,
    )


def _mass(structure: Structure, truth: dict[str, float], folder: Path) -> float:
    if isinstance(structure.deck, dict):
        return 1.0
    asked = ModeSet(
        np.arange(1.0, structure.n_modes + 1.0), np.ones((1, structure.n_modes)),
        np.array(structure.sensors[:1]), np.array([1]), np.zeros(0), "unknown",
    )  # fmt: skip
    return modetune.modes(campaign_of(structure, asked, folder), truth).mass


def _right(
    change: Any, hidden: Hidden, kind: str, search: ChangeSearch, exact: ChangeSearch
) -> bool:
    if kind == "none":
        return False
    if change.kind == NAMES[kind]:
        if kind == "clamp":
            if change.component == hidden.component:
                return True
        elif kind == "softened":
            if change.quantity is not None and hidden.material in change.quantity.targets:
                return True
        elif hidden.node in change.nodes and (
            kind == "mass" or change.component == hidden.component
        ):
            return True
    alike = next((item for item in exact.changes if item.label == change.label), None)
    if alike is None:
        return False
    refined = exact.refined(alike, exact.screened(alike)[1])
    return refined is not None and refined.misfit < ALIKE


def _has(family: str, kind: str) -> bool:
    """Whether a family has such changes."""
    if kind == "clamp":
        return family in CLAMPED
    if kind != "softened":
        return True
    parameters = FAMILIES[family](np.random.default_rng(1)).parameters
    return len(parameters) > 1 and "material" in parameters[-1]


def _quiet() -> None:
    """Each worker has one core."""
    logging.disable(logging.WARNING)
    threadpool_limits(1)


def table(outcomes: list[Outcome]) -> str:
    """A line a kind, and one a family of those with something to find."""
    lines = [
        f"{'':18}{'twins':>8}{'too small':>11}{'failed':>8}{'proposed':>10}{'right first':>13}"
        f"{'in three':>10}{'changes':>9}{'runs':>6}{'seconds':>9}"
    ]
    groups = [(kind, "kind") for kind in dict.fromkeys(item.kind for item in outcomes)]
    groups += [(name, "family") for name in dict.fromkeys(item.family for item in outcomes)]
    for name, of in groups:
        own = [item for item in outcomes if getattr(item, of) == name]
        own = [item for item in own if of == "kind" or item.kind != "none"]
        small = [item for item in own if item.failed == "too small to see"]
        failed = [item for item in own if item.failed and item not in small]
        rest = [item for item in own if not item.failed]
        if not own:
            continue
        medians = [
            float(np.median([getattr(item, key) for item in rest])) if rest else float("nan")
            for key in ("changes", "runs", "seconds")
        ]
        lines.append(
            f"{name:18}{len(own):8d}{len(small):11d}{len(failed):8d}"
            f"{sum(item.proposed for item in rest):10d}{sum(item.rank == 1 for item in rest):13d}"
            f"{sum(item.rank > 0 for item in rest):10d}{medians[0]:9.0f}{medians[1]:6.0f}"
            f"{medians[2]:9.1f}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=100, help="twins in all")
    parser.add_argument("--seed", type=int, default=1, help="of the first twin of a family")
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(OF))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--to", type=Path, help="lines of JSON, one a twin; what it has is not run")
    asked = parser.parse_args()
    each = max(1, round(asked.runs / len(asked.families) / len(asked.kinds)))
    twins = [
        (family, asked.seed + place, kind)
        for place in range(each)
        for kind in asked.kinds
        for family in asked.families
        if _has(family, kind)
    ]
    known = asked.to.read_text().splitlines() if asked.to and asked.to.exists() else []
    outcomes = [Outcome(**json.loads(line)) for line in known]
    done = {(item.family, item.seed, item.kind) for item in outcomes}
    left = [twin for twin in twins if twin not in done]
    with ProcessPoolExecutor(asked.workers, initializer=_quiet) as pool:
        for waiting in as_completed([pool.submit(try_twin, *twin) for twin in left]):
            outcome = waiting.result()
            outcomes.append(outcome)
            if asked.to:
                with asked.to.open("a") as file:
                    file.write(f"{json.dumps(asdict(outcome))}\n")
            said = outcome.failed.strip().splitlines()[-1:] or [
                f"rank {outcome.rank}, {outcome.first} {outcome.value:.4g}, proposed "
                f"{outcome.proposed}, {outcome.seconds:.0f} s"
            ]
            sys.stderr.write(
                f"{outcome.family} {outcome.seed} {outcome.kind}: {outcome.hidden}, "
                f"{outcome.noncentrality:.1f}; {said[0]}\n"
            )
    sys.stdout.write(f"{table(outcomes)}\n")


if __name__ == "__main__":
    main()
