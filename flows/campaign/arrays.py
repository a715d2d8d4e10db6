"""A campaign made of Python objects: an ordinary campaign file, with arrays as files next to it.

Keys are those of the campaign file. Two keys may have arrays instead of the path of a file:

    model   stiffness, mass (n, n), dense or sparse; parts: {name: {stiffness, mass}}, what each
            parameter scales; dofs: n names such as "12.z" or pairs (12, "z"), else unknown i is
            component x of node i. The solver is `matrices`.
            Or function: a function of the parameters' values, or the function alone; dofs: names of
            the rows of what it returns, the test's by default; version: of its results. Parameters
            then have a `value`, what the function gets at 1: {k1: 1100.0}, or a list with the keys
            of a campaign file. adapters/function says what it may take and return.
    test    frequencies_hz (n_modes,), and where shapes were measured mode_shapes
            (n_sensors, n_modes) with the dofs (n_sensors) of their rows; numbers (n_modes,) of the
            modes, else 1, 2, ...; damping_ratios (n_modes,). Or modes: a Measurement or a ModeSet.

The command line can run, repeat and schedule the written campaign as it is, unless its model is a
function, which no file holds.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy import sparse

from modetune.adapters.function.solver import UserFunction
from modetune.adapters.matrices.matrix_files import write_matrix
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.algebra.factorisation import symmetric_matrix
from modetune.core.errors import CampaignError, ModelError, ModesError
from modetune.core.measurement.measurement import Measurement
from modetune.core.modes import COMPONENTS, MeasuredModes, ModeSet, dof_name, mode_set
from modetune.core.storage.files import storage_errors
from modetune.flows.campaign.schema import STORE_VARIABLE
from modetune.flows.campaign.solvers import FUNCTION

#: Keys of a model and of a test that are given as arrays.
MODEL_ARRAYS = {"stiffness", "mass", "parts", "dofs"}
FUNCTION_KEYS = {"function", "version", "dofs"}
TEST_ARRAYS = {"frequencies_hz", "mode_shapes", "dofs", "numbers", "damping_ratios"}
#: Folder of written campaigns by default, below the current one.
MADE = Path(".modetune") / "campaigns"

Dof = tuple[int, int]


def write_campaign(given: Mapping[str, Any], folder: Path | None = None) -> Path:
    """Write a campaign and its arrays into a folder; returns the campaign file.

    folder: `.modetune/campaigns/NAME` below the current one where None. Paths in the mapping are
    relative to the current folder. Raises CampaignError with all that does not fit,
    StorageUnavailable.
    """
    campaign = {key: _plain(value) for key, value in given.items()}
    function, problems = user_function(given), list[str]()
    if function is not None:
        try:
            campaign |= _function_campaign(campaign, function)
        except (CampaignError, ModelError, ModesError) as error:
            raise CampaignError(f"model: {error}") from error
    folder = (folder or MADE / str(given.get("name", "campaign"))).resolve()
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        _sides(campaign, folder, "", problems)
        for item in campaign.get("configurations") or ():
            if isinstance(item, dict):
                _sides(item, folder, f"{item.get('name')}-", problems)
        if problems:
            raise CampaignError(problems)
        if "store" not in campaign and STORE_VARIABLE not in os.environ:
            campaign["store"] = str(Path.cwd() / ".modetune" / "store")
        path = folder / "campaign.yaml"
        try:
            path.write_text(yaml.safe_dump(campaign, sort_keys=False), encoding="utf-8")
        except yaml.YAMLError as error:
            raise CampaignError(
                f"a campaign may contain only mappings, lists, numbers and text: {error}"
            ) from None
    return path


def user_function(given: Mapping[str, Any]) -> UserFunction | None:
    """Return the function that is a campaign's model, None where it is none."""
    model: Any = given.get("model")
    version = None
    if isinstance(model, Mapping):
        model, version = model.get("function"), model.get("version")
    if model is None or isinstance(model, str):
        return None
    if not callable(model):
        raise CampaignError(f"model: `function` is a {type(model).__name__}, not a function")
    return UserFunction(model, "" if version is None else str(version))


def _function_campaign(campaign: dict[str, Any], function: UserFunction) -> dict[str, Any]:
    """Return model, parameters and run of a campaign whose model is a function.

    Raises CampaignError, ModelError, ModesError.
    """
    given = campaign["model"]
    model = {} if callable(given) else {k: v for k, v in given.items() if k not in FUNCTION_KEYS}
    parameters, values = list[Any](), dict[str, float]()
    listed = campaign.get("parameters") or ()
    if isinstance(listed, dict):
        listed = [
            {"name": name, **(item if isinstance(item, dict) else {"value": item})}
            for name, item in listed.items()
        ]
    for item in listed:
        own = dict(item)
        value = own.pop("value", None)
        if value is not None:
            values[str(own.get("name"))] = float(value)
        own.setdefault("quantity", "variable" if value is None else "number")
        parameters.append(own)
    if not values:
        raise CampaignError("a function needs parameters with a `value`, such as {'k1': 1100.0}")
    dofs = None if callable(given) else given.get("dofs")
    rows = _test_dofs(campaign.get("test")) if dofs is None else [_dof(item) for item in dofs]
    if not rows:
        raise CampaignError(
            "the test has no sensors that could name the rows of what the function returns; give "
            "`dofs`: {'function': ..., 'dofs': ['1.x', '2.x']}"
        )
    deck = {"function": function.place, "values": values, "dofs": [dof_name(dof) for dof in rows]}
    run = {"parallel": 1, **(campaign.get("run") or {})}
    held = {"solver": FUNCTION, "units": "m-kg-s", **model, "deck": deck}
    return {"model": held, "parameters": parameters, "run": run}


def _test_dofs(test: Any) -> list[Dof]:
    """Return the degrees of freedom of a test's shapes. Raises CampaignError, ModesError."""
    given = test.get("modes") if isinstance(test, dict) else test
    if isinstance(test, dict) and "dofs" in test:
        return [_dof(item) for item in test["dofs"]]
    if isinstance(given, str | os.PathLike):
        given = [given]
    if isinstance(given, list | tuple):
        given = read_measurement([Path(item) for item in given])
    if isinstance(given, Measurement):
        given = given.modes
    modes = given.modes if isinstance(given, MeasuredModes) else given
    if not isinstance(modes, ModeSet):
        return []
    return list(zip(modes.nodes.tolist(), modes.components.tolist(), strict=True))


def _sides(holder: dict[str, Any], folder: Path, prefix: str, problems: list[str]) -> None:
    """Write the arrays of a campaign or configuration, and make paths absolute."""
    for key, write in (("model", _write_model), ("test", _write_test)):
        side = holder.get(key)
        if isinstance(side, Measurement | MeasuredModes | ModeSet):
            side = {"modes": side}
        if not isinstance(side, dict):
            continue
        try:
            holder[key] = write(dict(side), folder, prefix)
        except (ModelError, ModesError, CampaignError) as error:
            problems.append(f"{key}: {error}")


def _write_model(model: dict[str, Any], folder: Path, prefix: str) -> dict[str, Any]:
    if model.get("solver") == FUNCTION and isinstance(model.get("deck"), dict):
        deck = folder / f"{prefix}model.yaml"
        deck.write_text(yaml.safe_dump(model["deck"], sort_keys=False), encoding="utf-8")
        return {**model, "deck": deck.name}
    if "stiffness" not in model and "mass" not in model:
        if isinstance(model.get("deck"), str | os.PathLike):
            model["deck"] = str(Path(model["deck"]).resolve())
        return model
    arrays = {key: model.pop(key) for key in MODEL_ARRAYS if key in model}
    missing = {"stiffness", "mass"} - set(arrays)
    if missing:
        raise ModelError(f"a model given as arrays requires `{missing.pop()}`")
    index: dict[str, Any] = {}
    for key in ("stiffness", "mass"):
        index[key] = _write_matrix(arrays[key], folder, f"{prefix}{key}", key)
    parts = arrays.get("parts") or {}
    index["parts"] = {
        str(name): {
            kind: _write_matrix(matrix, folder, f"{prefix}{name}_{kind}", f"part {name}: {kind}")
            for kind, matrix in part.items()
        }
        for name, part in parts.items()
    }
    if arrays.get("dofs") is not None:
        names = [f"{node}.{COMPONENTS[axis - 1]}" for node, axis in map(_dof, arrays["dofs"])]
        (folder / f"{prefix}dofs.txt").write_text("\n".join(names) + "\n", encoding="utf-8")
        index["dofs"] = f"{prefix}dofs.txt"
    deck = folder / f"{prefix}model.yaml"
    deck.write_text(yaml.safe_dump(index, sort_keys=False), encoding="utf-8")
    return {"solver": "matrices", "units": "m-kg-s", **model, "deck": deck.name}


def _write_matrix(given: Any, folder: Path, name: str, what: str) -> str:
    matrix: Any = given if sparse.issparse(given) else np.asarray(given, dtype=np.float64)
    write_matrix(folder, f"{name}.npz", symmetric_matrix(matrix, what))
    return f"{name}.npz"


def _write_test(test: dict[str, Any], folder: Path, prefix: str) -> dict[str, Any]:
    given = test.get("modes")
    if isinstance(given, ModeSet):
        given = MeasuredModes(tuple(range(1, given.n_modes + 1)), given)
    if isinstance(given, MeasuredModes):
        given = Measurement(given)
    if "frequencies_hz" in test:
        given = Measurement(_measured({key: test.pop(key) for key in TEST_ARRAYS if key in test}))
    if isinstance(given, Measurement):
        write_test_hdf5(folder / f"{prefix}test.h5", given)
        return {**test, "modes": f"{prefix}test.h5"}
    if isinstance(given, str | os.PathLike):
        given = [given]
    if isinstance(given, list | tuple):
        paths = [str(Path(item).resolve()) for item in given]
        test["modes"] = paths if len(paths) > 1 else paths[0]
    return test


def _measured(arrays: dict[str, Any]) -> MeasuredModes:
    """Return measured modes from arrays. Raises ModesError where they do not fit together."""
    shapes = arrays.get("mode_shapes")
    dofs = [_dof(item) for item in arrays.get("dofs", ())]
    if shapes is not None and len(dofs) != np.shape(shapes)[0]:
        raise ModesError(
            f"mode_shapes has {np.shape(shapes)[0]} rows but dofs has {len(dofs)} entries; give "
            "one node and component per row"
        )
    modes = mode_set(
        arrays["frequencies_hz"],
        shapes,
        [node for node, _ in dofs],
        [axis for _, axis in dofs],
        arrays.get("damping_ratios", ()),
    )
    numbers = tuple(int(number) for number in arrays.get("numbers", range(1, modes.n_modes + 1)))
    if len(numbers) != modes.n_modes:
        raise ModesError(f"{len(numbers)} numbers for {modes.n_modes} modes")
    return MeasuredModes(numbers, modes)


def _dof(given: Any) -> Dof:
    """Return node and component 1..6 of "12.z", (12, "z") or (12, 3). Raises ModesError."""
    parts = given.split(".") if isinstance(given, str) else list(given)
    if len(parts) == 2:
        node, axis = str(parts[0]), parts[1]
        number = COMPONENTS.index(axis) + 1 if axis in COMPONENTS else axis
        if node.isdecimal() and str(number) in "123456" and str(number):
            return int(node), int(number)
    raise ModesError(f'{given!r} is not a degree of freedom such as "12.z" or (12, "z")')


def _plain(value: Any) -> Any:
    """Return a campaign's value as YAML has it; arrays and objects of model and test remain."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, os.PathLike) else value
