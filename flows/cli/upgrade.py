"""`modetune upgrade`: records, histories and stores of earlier formats, rewritten to the newest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from modetune.core.errors import ModetuneError
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, show_progress, stoppable
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import json_object


def upgrade(
    places: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders with run folders or stores, files, or campaign files, which name a run "
            "folder and a store; default: the current folder."
        ),
    ] = None,
    runs: Annotated[Path, typer.Option(help="Folder of the run folders of campaign files.")] = Path(
        "runs"
    ),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Read and verify all files, and write nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Rewrite records, past runs and stored results of earlier formats.

    Each file is verified, written under another name, verified again and renamed, so that a kill
    loses nothing and the same command continues. Campaigns may run at the same time. Versions that
    wrote the earlier formats cannot read the new files. A file that cannot be upgraded stays as it
    is, and the exit code is 2.
    """
    from modetune.core.monitoring.past_runs import PAST_RUN
    from modetune.core.storage.campaign_record import CAMPAIGN
    from modetune.core.storage.upgrade import SealedFile, sealed_files, upgrade_file
    from modetune.flows.studies.sample.record import POSTERIOR
    from modetune.flows.studies.scatter.record import SCATTER
    from modetune.flows.studies.screen.record import SCREENING

    kinds = (CAMPAIGN, PAST_RUN, SCREENING, SCATTER, POSTERIOR)
    counts: Counter[str] = Counter()
    old: list[SealedFile] = []
    with (
        stoppable("stopped; the same command continues from there"),
        show_progress("looking for files of earlier formats") as working,
    ):
        for path in sealed_files(_folders(places or [Path()], runs)):
            found = upgrade_file(path, kinds, dry_run)
            if found is None:
                continue
            counts[found.state] += 1
            if found.state != "newest":
                old.append(found)
                working(f"{counts['upgraded']} upgraded, {counts['left']} left, at {path}")
    left = [item for item in old if item.state == "left"]
    told: Json = {
        "dry_run": dry_run,
        "newest": counts["newest"],
        "upgraded": [json_object(item, "path noun format") for item in old if item not in left],
        "left": [json_object(item, "path noun format reason") for item in left],
    }
    lines = [f"left as it is: {item.reason}" for item in left]
    kinds_of = Counter((item.noun, item.format) for item in old if item not in left)
    done = "to be upgraded" if dry_run else "upgraded"
    lines += [f"{count:7} {noun}, format {n}: {done}" for (noun, n), count in kinds_of.items()]
    lines.append(f"{counts['newest']:7} of the newest format already")
    print_result(told, lines, as_json)
    if left:
        raise typer.Exit(ModetuneError.exit_code)


def _folders(places: Sequence[Path], runs: Path) -> Iterator[Path]:
    """Yield the folders and files that places name. Raises CampaignError."""
    from modetune.adapters.yaml_file import read_yaml
    from modetune.flows.campaign.campaign import store_of
    from modetune.flows.studies.history.named_runs import run_folder

    for place in places:
        if place.suffix not in (".yaml", ".yml"):
            yield place
            continue
        folder, _ = run_folder(place, runs)
        store = store_of(read_yaml(place, "a campaign")).folder
        yield from (one for one in (folder, store) if one.exists())
