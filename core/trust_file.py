"""The group /trust of a campaign's record: how far its parameters can be trusted.

    /trust/               attributes: verdict, sentences, unseen, concerns, notes (a line each),
                          agrees, condition, n_told, regularisation, age, collinearity (whole),
                          times_noise
                          test_shares, standard_errors, updated, on_bound    (n_parameters,)
                          names, collinear_with, flags, clauses (a line each one), sentence
                          singular_values (n_parameters,), vectors, resolution (n_par, n_par)
                          collinear_members (n_kept, 3), collinear_indices (n_kept,)
    /trust/unseen/000/    members, changes (n_members,); attribute seen
    /trust/l_curve/       factors, misfits, sizes; attribute corner
    /trust/starts/        starts, updated (n_starts, n_parameters), misfits, minima, outcomes
                          (n_starts,), rivals, differ; attributes chosen, seed

`core/trust.py` and `core/identifiability.py` say what each is.
"""

from __future__ import annotations

from collections.abc import Sequence

import h5py

from modetune.core.estimation import LCurve
from modetune.core.groups import texts
from modetune.core.identifiability import Collinearity, Identifiability, UnseenCombination
from modetune.core.judgement import trust_sentences
from modetune.core.trust import ParameterTrust, StartSpread, Trust


def write_trust(file: h5py.Group, trust: Trust | None) -> None:
    """Write the group; nothing where nothing is known."""
    if trust is None:
        return
    group, found, items = file.create_group("trust"), trust.identifiability, trust.parameters
    group.attrs.update(
        verdict=trust.verdict,
        sentences="\n".join(trust_sentences(trust)),
        unseen="\n".join(trust.unseen),
        concerns="\n".join(trust.concerns),
        notes="\n".join(trust.notes),
        agrees=trust.agrees,
        times_noise=trust.times_noise,
        condition=found.condition,
        n_told=found.n_told,
        regularisation=trust.regularisation,
        age=trust.age,
        collinearity=found.collinearity.whole,
    )
    _write_texts(group, "names", [item.name for item in items])
    _write_texts(group, "collinear_with", ["\n".join(item.collinear_with) for item in items])
    _write_texts(group, "flags", ["\n".join(item.flags) for item in items])
    _write_texts(group, "clauses", ["\n".join(item.clauses) for item in items])
    _write_texts(group, "sentence", [item.sentence for item in items])
    group["test_shares"] = [item.test_share for item in items]
    group["standard_errors"] = [item.standard_error for item in items]
    group["updated"] = [item.updated for item in items]
    group["on_bound"] = [item.on_bound for item in items]
    group["singular_values"] = found.singular_values
    group["vectors"] = found.vectors
    group["resolution"] = found.resolution
    group["collinear_members"] = found.collinearity.members
    group["collinear_indices"] = found.collinearity.indices
    for number, item in enumerate(found.unseen):
        made = group.create_group(f"unseen/{number:03d}")
        made["members"], made["changes"] = list(item.members), item.changes
        made.attrs["seen"] = item.seen
    if trust.curve is not None:
        made = group.create_group("l_curve")
        made["factors"], made["misfits"] = trust.curve.factors, trust.curve.misfits
        made["sizes"] = trust.curve.sizes
        made.attrs["corner"] = trust.curve.corner
    if trust.spread is not None:
        _write_starts(group.create_group("starts"), trust.spread)


def read_trust(file: h5py.Group) -> Trust | None:
    """The group as it was written; None where the file has none."""
    if "trust" not in file:
        return None
    group = file["trust"]
    attrs, unseen = group.attrs, group.get("unseen", {})
    return Trust(
        parameters=_read_parameters(group),
        identifiability=Identifiability(
            singular_values=group["singular_values"][()],
            vectors=group["vectors"][()],
            resolution=group["resolution"][()],
            collinearity=Collinearity(
                group["collinear_members"][()],
                group["collinear_indices"][()],
                float(attrs["collinearity"]),
            ),
            unseen=tuple(_read_unseen(unseen[name]) for name in sorted(unseen, key=int)),
        ),
        agrees=bool(attrs["agrees"]),
        unseen=_lines(attrs["unseen"]),
        curve=_read_curve(group),
        regularisation=float(attrs["regularisation"]),
        age=int(attrs["age"]),
        spread=_read_starts(group),
        concerns=_lines(attrs["concerns"]),
        notes=_lines(attrs["notes"]),
        times_noise=float(attrs.get("times_noise", 0.0)),
    )


def _read_parameters(group: h5py.Group) -> tuple[ParameterTrust, ...]:
    columns = zip(
        texts(group, "names"),
        *(group[name][()].tolist()
          for name in ("updated", "standard_errors", "test_shares", "on_bound")),
        *(map(_lines, texts(group, name)) for name in ("collinear_with", "flags", "clauses")),
        strict=True,
    )  # fmt: skip
    return tuple(ParameterTrust(*row) for row in columns)


def _read_unseen(group: h5py.Group) -> UnseenCombination:
    members = tuple(group["members"][()].tolist())
    return UnseenCombination(members, group["changes"][()], float(group.attrs["seen"]))


def _read_curve(group: h5py.Group) -> LCurve | None:
    if "l_curve" not in group:
        return None
    found = group["l_curve"]
    factors, misfits, sizes = (found[name][()] for name in ("factors", "misfits", "sizes"))
    return LCurve(factors, misfits, sizes, float(found.attrs["corner"]))


def _write_starts(group: h5py.Group, spread: StartSpread) -> None:
    group.attrs.update(chosen=spread.chosen, seed=spread.seed)
    group["starts"], group["updated"] = spread.starts, spread.updated
    group["misfits"], group["minima"] = spread.misfits, spread.minima
    _write_texts(group, "outcomes", spread.outcomes)
    _write_texts(group, "differ", spread.differ)
    group["rivals"] = list(spread.rivals)


def _read_starts(group: h5py.Group) -> StartSpread | None:
    if "starts" not in group:
        return None
    found = group["starts"]
    return StartSpread(
        starts=found["starts"][()],
        updated=found["updated"][()],
        misfits=found["misfits"][()],
        outcomes=tuple(texts(found, "outcomes")),
        minima=found["minima"][()],
        rivals=tuple(int(number) for number in found["rivals"][()]),
        differ=tuple(texts(found, "differ")),
        chosen=int(found.attrs["chosen"]),
        seed=int(found.attrs["seed"]),
    )


def _write_texts(group: h5py.Group, name: str, texts: Sequence[str]) -> None:
    group.create_dataset(name, data=list(texts), dtype=h5py.string_dtype())


def _lines(text: object) -> tuple[str, ...]:
    return tuple(str(text).splitlines())
