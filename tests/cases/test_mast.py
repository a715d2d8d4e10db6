"""A mast on soft mounts by three tests at once: modes, a pull at its head and a weighing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.configs.mast import twin
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.responses.mass_properties import MassSection
from modetune.flows.responses.static import StaticSection
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx

pytestmark = needs_ccx
TRUTH = [twin.TRUTH[name] for name in ("E_MAST", "rho_HEAD", "MOUNT_SIDE", "MOUNT_UP")]
#: Of the names of items in the record.
MODES, PULL, BALANCE = "frequency", "displacement", "mass"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mast")
    write_case("mast", path)
    return path


def updated(folder: Path, *settings: str) -> CampaignRecord:
    campaign = load_campaign(folder / "mast.yaml", list(settings))
    return update_campaign(campaign, folder / "runs", Unwatched()).record


@pytest.fixture(scope="module")
def whole(folder: Path) -> CampaignRecord:
    """The update by all three tests."""
    return updated(folder)


def test_three_tests_at_once_tell_stiffness_and_mass(whole: CampaignRecord) -> None:
    record = whole
    assert record.status == "converged"
    labels = record.best.residual.labels
    for kind in (MODES, PULL, BALANCE):
        assert any(label.startswith(kind) for label in labels), kind
    # Noise is as the campaign states it, so the truth lies within three standard errors: less
    # than 0.3 % of tests miss that for a parameter.
    assert (np.abs(record.updated - TRUTH) < 3.0 * record.standard_errors).all()
    assert (record.standard_errors < 0.01).all()
    assert record.trust is not None
    assert record.trust.verdict == "trusted"


def test_modes_alone_tell_the_head_and_the_moduli_worse(
    folder: Path, whole: CampaignRecord
) -> None:
    left_out = ("residuals.static=null", "residuals.mass_properties=null")
    modes = updated(folder, *left_out, "update.starts=1")
    assert (modes.standard_errors > whole.standard_errors).all()


def test_the_campaigns_numbers_are_what_ccx_finds_for_the_true_mast(folder: Path) -> None:
    campaign = load_campaign(folder / "mast.yaml")
    test, modes = campaign.case.test.modes, twin.truth_modes()
    np.testing.assert_allclose(
        test.frequencies_hz, modes.frequencies_hz, rtol=4.0 * twin.FREQUENCY_NOISE
    )
    static = campaign.residuals.kinds["static"]
    assert isinstance(static, StaticSection)
    moved = twin.truth_displacements()
    read = static.cases[0].displacements
    assert {int(name.partition(".")[0]) for name in read} == set(twin.GAUGES)
    largest = max(map(abs, read.values()))
    for name, value in read.items():
        node, _, component = name.partition(".")
        true = moved[int(node)]["xyz".index(component)]
        assert abs(value - true) < 4.0 * twin.GAUGE_NOISE * largest
    weighed = campaign.residuals.kinds["mass_properties"]
    assert isinstance(weighed, MassSection)
    mass = weighed.targets["mass"].value
    assert mass == pytest.approx(twin.truth_mass(), rel=4.0 * twin.WEIGHING_NOISE)
