"""Settings of the command line over a campaign file: `--set KEY.KEY=VALUE`."""

from __future__ import annotations

import yaml

from modetune.adapters.yaml_file import YamlFile
from modetune.core.errors import CampaignError


def override(file: YamlFile, settings: list[str]) -> dict[str, object]:
    """The file's data with `key.key=value` settings applied, values read as YAML.

    Raises CampaignError where a setting has no such form or leads through a value.
    """
    data = yaml.safe_load(file.text)
    for setting in settings:
        path, separator, text = setting.partition("=")
        *outer, last = path.strip().split(".")
        target = data
        for key in outer:
            target = target.setdefault(key, {}) if isinstance(target, dict) else None
        if not separator or not last or not isinstance(target, dict):
            raise CampaignError(f"--set {setting!r}: expected KEY.KEY=VALUE, e.g. update.e2=0.002")
        try:
            target[last] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise CampaignError(f"--set {setting!r}: the value is not YAML") from error
    return dict(data)
