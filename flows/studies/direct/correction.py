"""Corrections of whole matrices from measured modes, and what they break: `modetune model direct`.

Direct methods reproduce the test at once, and know nothing of springs and plates. What a user has
to know before a corrected matrix is used: where it couples unknowns that no element joins, how much
of it is at unknowns that were not measured, whether it is still a stiffness and a mass (no negative
eigenvalue), whether rigid motion costs energy now, and which modes that were not measured moved.

The corrected matrices are full, so that their model has to be small: a large one is reduced to its
sensors first (`modetune model reduce --out FILE.yaml`), as the field does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import spsolve

from modetune.adapters.matrices.export import WrittenMatrices
from modetune.core.algebra.eigen import solve_modes
from modetune.core.brief import brief
from modetune.core.condensation.measured_unknowns import MeasuredModel
from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import Floats, Integers, ModeSet, Normalisation, mode_set
from modetune.core.parameters import Values
from modetune.core.updating.direct_update import (
    DirectUpdate,
    LowRankChange,
    ReferenceModes,
    direct_matrix_update,
    error_matrix_update,
)
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.report.tables import Column
from modetune.flows.studies.direct.request import DirectMethod, Filling
from modetune.flows.studies.full_model import (
    FullModel,
    by_sensors,
    full_model,
    relative,
    sensor_names,
)

#: Eigenvalues and couplings below this part of the largest, an unknown, are rounding.
ROUNDING = 1e-13


@dataclass(frozen=True, slots=True)
class MatrixDamage:
    """What a change breaks in one matrix, each entry by the roots of its diagonal ones, so that
    units do not count.

    size: of the change over that of the matrix; couplings: entries that were zero and are not;
    outside: the part of the change's size at entries that were zero; unmeasured: that at rows or
    columns that no sensor sees; negative: negative eigenvalues that it brought.
    """

    matrix: str
    size: float
    couplings: int
    outside: float
    unmeasured: float
    negative: int


def damage_of(
    name: str, before: sparse.csr_array, change: Floats, watched: sparse.csr_array
) -> MatrixDamage:
    """What a change (n, n) breaks in a matrix."""
    matrix: Floats = before.toarray()
    diagonal = np.abs(np.diag(matrix))
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, diagonal[diagonal > 0.0].mean()))
    whole, added = matrix * np.outer(scale, scale), change * np.outer(scale, scale)
    new = (matrix == 0.0) & (np.abs(added) > ROUNDING * np.abs(whole).max())
    unseen = np.ones(matrix.shape[0], dtype=np.bool_)
    unseen[watched.indices] = False
    size = float(np.linalg.norm(added))
    part = size or 1.0
    return MatrixDamage(
        matrix=name,
        size=size / float(np.linalg.norm(whole)),
        couplings=int(new.sum()),
        outside=float(np.linalg.norm(added[new])) / part,
        unmeasured=float(np.linalg.norm(added[unseen[:, None] | unseen])) / part,
        negative=_negative(np.asarray(whole + added)) - _negative(whole),
    )


def _negative(matrix: Floats) -> int:
    """Eigenvalues below zero by more than rounding (n eps of the largest, and sums of it)."""
    values = np.linalg.eigvalsh(matrix)
    return int((values < -ROUNDING * values.size * np.abs(values).max()).sum())


#: Unknowns of a model whose full matrices are still handled at ease: 70 MB each.
MOST = 3000
#: As in reductions: below this part of the highest eigenvalue looked at a mode is rigid.
REST = 1e-8
#: A corrected mode of this MAC with an imposed shape is that one.
SAME = 0.99


@dataclass(frozen=True, slots=True)
class CorrectedMode:
    """A mode of the corrected model, and the test's or the model's own one that it is most like.

    test: number of the test's mode, None where it is none; difference: of frequency to that,
    relative; initial_hz: of the first model's mode that it is most like, mac: how much.
    """

    mode: Annotated[int, Column("mode")]
    corrected_hz: Annotated[float, Column("corrected", "Hz", ".5g")]
    test: Annotated[int | None, Column("test mode", words=True)]
    difference: Annotated[float, Column("off the test", "%", "+.2g")]
    initial_hz: Annotated[float, Column("most like before", "Hz", ".5g")]
    mac: Annotated[float, Column("by MAC", form=".3f")]


@dataclass(frozen=True, slots=True, repr=False)
class DirectCorrection:
    """A model corrected by a direct method.

    imposed: numbers of the test's modes that were used; lost: those without a partner in the model,
    which the method had to leave out. modes: the lowest of the corrected model. residual: largest
    of |K phi - w^2 M phi| over |K phi| of the test's modes, at all unknowns. rigid_hz: frequency
    that rigid motion now has, 0 without rigid modes. condition: of the worst inverse.
    """

    method: DirectMethod
    filling: Filling
    n: int
    n_seen: int
    imposed: tuple[int, ...]
    lost: tuple[int, ...]
    modes: tuple[CorrectedMode, ...]
    why_no_modes: str
    damage: tuple[MatrixDamage, MatrixDamage]
    residual: float
    rigid_hz: float
    condition: float
    matrices: WrittenMatrices

    __repr__ = brief

    @property
    def notes(self) -> tuple[str, ...]:
        """What it breaks, a sentence each."""
        texts = []
        for item in self.damage:
            if item.size == 0.0:
                continue
            texts.append(
                f"{item.matrix}: changed by {100.0 * item.size:.3g} % of its size; "
                f"{item.couplings} couplings of unknowns that no element joins, "
                f"{100.0 * item.outside:.3g} % of the change; {100.0 * item.unmeasured:.3g} % of "
                f"it at unknowns that no sensor sees ({self.n - self.n_seen} of {self.n})"
            )
            if item.negative:
                texts.append(
                    f"{item.matrix} has {item.negative} negative eigenvalues more than before: it "
                    "is not that of a structure"
                )
        if self.rigid_hz > 0.0:
            texts.append(f"rigid motion is not free any more: it has up to {self.rigid_hz:.4g} Hz")
        if self.lost:
            texts.append(
                f"without a partner in the model, and so left out: test mode "
                f"{', '.join(map(str, self.lost))}"
            )
        if self.why_no_modes:
            texts.append(f"the corrected matrices have no modes to show: {self.why_no_modes}")
        return tuple(texts)

    @property
    def sentence(self) -> str:
        """What came out, for people."""
        return (
            f"{self.method} with {len(self.imposed)} test modes at {self.n_seen} of {self.n} "
            f"unknowns (filled by {self.filling}): these are modes of the corrected model to "
            f"{self.residual:.2g}"
        )


def correct_directly(
    campaign: Campaign,
    values: Values,
    method: DirectMethod = "berman",
    filling: Filling = "kidder",
    mass_normalised: bool = False,
) -> DirectCorrection:
    """Correct a model's matrices. Raises CampaignError, ModesError, ModelError, SolverError.

    mass_normalised: whether the test's shapes are of unit modal mass in the deck's own unit; else
    they are scaled to that in the model, and so say nothing of the whole mass.
    """
    subject = _subject(campaign, values)
    model, own, seen = subject.model, subject.own, subject.seen
    used, partners = _imposed(subject, method, filling)
    given = subject.test.select(used)
    scale: Normalisation = "mass" if mass_normalised else "unknown"
    reference = ReferenceModes(
        given.frequencies_hz, given.mode_shapes.real, seen.rows, scale, filling
    )
    found, stiffness, mass = _update(method, subject, reference, partners)
    k, m = model.stiffness.toarray() + stiffness, model.mass.toarray() + mass
    numbers = np.array(campaign.case.measured.numbers, dtype=np.int64)
    phi = np.asarray(seen.back @ found.mode_shapes)
    modes, why = _corrected(k, m, own, model, (numbers[used], given, phi))
    text = f"modetune direct: {campaign.name}, {method}, {used.size} modes, filled by {filling}"
    return DirectCorrection(
        method=method,
        filling=filling,
        n=len(k),
        n_seen=seen.rows.size,
        imposed=tuple(numbers[used].tolist()),
        lost=tuple(np.delete(numbers, used).tolist()),
        modes=modes,
        why_no_modes=why,
        damage=(
            damage_of("stiffness", model.stiffness, stiffness, subject.watched),
            damage_of("mass", model.mass, mass, subject.watched),
        ),
        residual=float(np.max(relative(k @ phi - m @ phi * given.eigenvalues, k @ phi))),
        rigid_hz=_rigid_hz(own, k, m),
        condition=found.condition,
        matrices=WrittenMatrices(
            k, m, model.matrices.nodes, model.matrices.components, comments=(text,)
        ),
    )


@dataclass(frozen=True, slots=True)
class _OwnModes:
    """Modes of the model before: frequencies (n_modes,) and shapes (n, n_modes) of elastic ones,
    shapes of rigid ones."""

    elastic_hz: Floats
    elastic: Floats
    rigid: Floats


def _modes_of(model: FullModel, count: int) -> _OwnModes:
    eigenvalues, shapes = solve_modes(model.stiffness, model.mass, count)
    rest = eigenvalues <= REST * np.abs(eigenvalues).max()
    frequencies = np.sqrt(eigenvalues[~rest]) / (2.0 * np.pi)
    return _OwnModes(frequencies, shapes[:, ~rest], shapes[:, rest])


@dataclass(frozen=True, slots=True)
class _Subject:
    """A model with its own modes, and the test at its sensors that can move.

    seen: the model with what they see for unknowns; watched: (n_seen, n), what they see of it.
    """

    model: FullModel
    own: _OwnModes
    test: ModeSet
    seen: MeasuredModel
    watched: sparse.csr_array


def _subject(campaign: Campaign, values: Values) -> _Subject:
    names = sensor_names(campaign)
    model = full_model(campaign, values)
    n = model.stiffness.shape[0]
    if n > MOST:
        raise CampaignError(
            f"{campaign.name} has {n} unknowns, and direct methods fill whole matrices: {MOST} is "
            "the most; reduce it first (`modetune model reduce --out reduced.yaml`) and name that"
        )
    wanted = by_sensors(model)
    seen, moving = model.seen(wanted, names)
    own = _modes_of(model, min(campaign.case.n_modes, n))
    test = campaign.case.measured.modes.rows(moving)
    if np.iscomplexobj(test.mode_shapes):
        raise CampaignError("direct methods are for undamped models: real shapes are required")
    return _Subject(model, own, test, seen, sparse.csr_array(wanted.matrix[moving]))


def _imposed(
    subject: _Subject, method: DirectMethod, filling: Filling
) -> tuple[Integers, Integers]:
    """Places of the test's modes that can be imposed, and of the model's modes that help."""
    own, test = subject.own, subject.test
    shapes = np.asarray(subject.watched @ own.elastic)
    computed = mode_set(own.elastic_hz, shapes, test.nodes, test.components)
    pairing = pair_by_shape(test, computed, drop=True)
    if method == "error_matrix" or filling == "model":
        return pairing.measured, pairing.computed
    return np.arange(test.n_modes), np.arange(min(computed.n_modes, len(shapes)))


def _update(
    method: DirectMethod, subject: _Subject, reference: ReferenceModes, partners: Integers
) -> tuple[DirectUpdate, Floats, Floats]:
    """The correction on the unknowns that are seen, and the changes (n, n) of stiffness and mass
    on the model's own; partners: places of its modes that help."""
    seen, own = subject.seen, subject.own
    back = sparse.csc_array(seen.back)
    n = back.shape[0]
    basis = spsolve(back, own.elastic[:, partners]).reshape(n, partners.size)
    if method == "error_matrix":
        found = error_matrix_update(
            seen.stiffness, seen.mass, reference, own.elastic_hz[partners], basis
        )
    else:
        keep = method == "baruch"
        found = direct_matrix_update(seen.stiffness, seen.mass, reference, basis, keep)
    stiffness, mass = (
        LowRankChange(spsolve(back.T.tocsc(), item.basis).reshape(n, -1), item.core).dense()
        for item in (found.stiffness_change, found.mass_change)
    )
    return found, stiffness, mass


def _corrected(
    k: Floats,
    m: Floats,
    own: _OwnModes,
    model: FullModel,
    imposed: tuple[Integers, ModeSet, Floats],
) -> tuple[tuple[CorrectedMode, ...], str]:
    """The lowest modes of the corrected model, as many as are known of the first; or why none."""
    count = own.elastic_hz.size + own.rigid.shape[1]
    try:
        eigenvalues, shapes = linalg.eigh(k, m, subset_by_index=(0, count - 1))
    except linalg.LinAlgError:  # unknowns without mass, or a mass matrix that is none any more
        try:
            pair = sparse.csr_array(k), sparse.csr_array(m)
            eigenvalues, shapes = solve_modes(*pair, count)
        except ModelError as error:
            return (), str(error)
    hertz = np.sign(eigenvalues) * np.sqrt(np.abs(eigenvalues)) / (2.0 * np.pi)
    numbers, test, phi = imposed
    first = np.hstack([own.rigid, own.elastic])
    first_hz = np.concatenate([np.zeros(own.rigid.shape[1]), own.elastic_hz])
    with_own, with_test = (_likeness(model.mass, shapes, other) for other in (first, phi))
    rows = []
    for place, value in enumerate(hertz.tolist()):
        partner, mine = int(with_own[place].argmax()), int(with_test[place].argmax())
        is_test = with_test[place, mine] > SAME
        number = int(numbers[mine]) if is_test else None
        away = value / float(test.frequencies_hz[mine]) - 1.0 if is_test else float("nan")
        before = float(first_hz[partner]), float(with_own[place, partner])
        rows.append(CorrectedMode(place + 1, value, number, away, *before))
    return tuple(rows), ""


def _likeness(mass: sparse.csr_array, shapes: Floats, others: Floats) -> Floats:
    """MAC in the metric of a mass matrix, (n_shapes, n_others)."""
    m_shapes, m_others = mass @ shapes, mass @ others
    sizes = np.outer(np.sum(shapes * m_shapes, axis=0), np.sum(others * m_others, axis=0))
    return np.asarray((shapes.T @ m_others) ** 2 / np.abs(sizes))


def _rigid_hz(own: _OwnModes, k: Floats, m: Floats) -> float:
    """The highest frequency that the rigid modes have now; 0 without them, or as good as free."""
    rigid = own.rigid
    if not rigid.shape[1]:
        return 0.0
    stiffness, mass = rigid.T @ k @ rigid, rigid.T @ m @ rigid
    largest = float(np.abs(linalg.eigvals(stiffness, mass)).max())
    highest = (2.0 * np.pi * own.elastic_hz.max(initial=0.0)) ** 2
    return float(np.sqrt(largest) / (2.0 * np.pi)) if largest > REST * highest else 0.0
