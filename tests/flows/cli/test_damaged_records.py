"""A damaged campaign.h5 is refused by every command that reads one, with what to do."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from modetune.core.storage.campaign_record import read_record
from tests.command_line import run_command as run
from tests.core.storage.test_sealed_file import damages

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
COMMANDS = (
    ("report", "runs/six-mass"),
    ("check", "campaign.yaml", "--against", "runs/six-mass/campaign.h5"),
    ("check", "campaign.yaml", "--against", "good.h5", "--record", "runs/six-mass/campaign.h5"),
    ("correlate", "runs/six-mass/campaign.h5"),
    ("correlate", "good.h5", "runs/six-mass/campaign.h5"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign that was run."""
    made = tmp_path_factory.mktemp("six")
    for file in SIX_MASS.iterdir():
        if file.is_file():
            shutil.copyfile(file, made / file.name)
    ended = run(made, "update", "campaign.yaml", "--no-prefect", "--set", "report.page=false")
    assert ended.returncode == 0, ended.stderr
    shutil.copyfile(made / "runs" / "six-mass" / "campaign.h5", made / "good.h5")
    return made


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_flipped_bit_is_refused_with_a_remedy(folder: Path, command: tuple[str, ...]) -> None:
    record = folder / "runs" / "six-mass" / "campaign.h5"
    good = (folder / "good.h5").read_bytes()
    for damaged in list(damages(good, 60))[::20]:
        record.write_bytes(damaged)
        ended = run(folder, *command)
        assert ended.returncode in (2, 5), ended.stderr
        assert "campaign.h5" in ended.stderr
        _, _, told = f"\n{ended.stderr}".partition("\nmodetune: ")
        assert told.count("\n") == 1
        assert "Traceback" not in ended.stderr
    spoilt = bytearray(good)
    spoilt[-1] ^= 1
    record.write_bytes(spoilt)
    ended = run(folder, *command)
    assert ended.returncode == 5
    assert "copy it again, or run the campaign again" in ended.stderr


def test_a_start_from_the_last_run_believes_no_damaged_record(folder: Path) -> None:
    record = folder / "runs" / "six-mass" / "campaign.h5"
    spoilt = bytearray((folder / "good.h5").read_bytes())
    spoilt[len(spoilt) // 2] ^= 1
    record.write_bytes(spoilt)
    ended = run(
        folder, "update", "campaign.yaml", "--no-prefect", "--set", "update.start=last",
        "--set", "report.page=false",
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert "the checksum of" in ended.stderr
    first = read_record(record).iterations[0].parameters
    np.testing.assert_array_equal(first, np.ones(first.size))
