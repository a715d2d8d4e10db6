"""The container files without an engine; tools/image_in_root.py carries the steps out."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())


def test_the_image_runs_as_an_ordinary_user_with_pinned_packages() -> None:
    last_stage = DOCKERFILE.rsplit("FROM ", 1)[1]
    assert re.search(r"^USER modetune$", last_stage, re.MULTILINE)
    assert "calculix-ccx" in last_stage
    assert "--no-deps --require-hashes --requirement requirements.txt" in DOCKERFILE
    assert "--no-deps --no-build-isolation ." in DOCKERFILE  # and nothing beside them
    text = (ROOT / "tools" / "requirements.txt").read_text().replace("\\\n", "")
    pinned = [line for line in text.splitlines() if not line.startswith("#")]
    hashed = r"[\w.\[\]-]+==[\w.+!]+ (; [^#]+)?( *--hash=sha256:[0-9a-f]{64})+"
    assert len(pinned) > 100
    assert [line for line in pinned if not re.fullmatch(hashed, line)] == []


def test_every_image_is_named_by_its_digest() -> None:
    images = [line.split()[1] for line in DOCKERFILE.splitlines() if line.startswith("FROM ")]
    images += [service["image"] for service in COMPOSE["services"].values()]
    ours = [image for image in images if image != "modetune"]
    assert len(ours) == 3
    assert all(re.fullmatch(r"[\w.:-]+@sha256:[0-9a-f]{64}", image) for image in ours)


def test_the_image_has_every_package_that_can_be_asked_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (everything,) = extras["all"]
    named = set(everything.removeprefix("modetune[").removesuffix("]").split(","))
    assert named == set(extras) - {"all", "bench", "dev"}
    asked = [*project["dependencies"], *(one for name in named for one in extras[name])]
    names = {re.split(r"[^\w-]", one)[0].lower().replace("_", "-") for one in asked}
    locked = re.findall(r"^([\w.-]+)==", (ROOT / "tools" / "requirements.txt").read_text(), re.M)
    assert names <= set(locked)


def test_everything_the_image_copies_is_there() -> None:
    copies = re.findall(r"^COPY (?!--from)(.+)$", DOCKERFILE, re.MULTILINE)
    names = [name for line in copies for name in line.split()[:-1]]
    assert len(names) > 5
    assert all((ROOT / name).exists() for name in names)


def test_compose_shows_the_server_on_loopback_only_and_holds_no_secret() -> None:
    ports = {name: service.get("ports", []) for name, service in COMPOSE["services"].items()}
    assert ports == {"database": [], "server": ["127.0.0.1:4200:4200"], "worker": []}
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    assert COMPOSE["services"]["database"]["networks"] == ["inside"]
    for service in COMPOSE["services"].values():
        for name, value in service.get("environment", {}).items():
            if re.search("PASSWORD|AUTH|CONNECTION_URL", name):
                assert "${MODETUNE_" in value
                assert ":?" in value  # refuses to start without
