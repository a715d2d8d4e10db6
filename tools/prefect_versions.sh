#!/bin/sh
# Runs the tests of Prefect's engine on the oldest Prefect that modetune allows and on the newest.
# Usage: prefect_versions.sh BIN     (the folder of a virtual environment's programs)
set -eu
bin=$1
oldest=$(sed -n 's/.*"prefect>=\([0-9.]*\),<4".*/\1/p' pyproject.toml)
installed=$("$bin/python" -c 'from importlib.metadata import version; print(version("prefect"))')
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for wanted in "==$oldest" "<4"; do
    place="$folder/$wanted"
    "$bin/pip" install --quiet --disable-pip-version-check --no-deps --target "$place" "prefect$wanted"
    found=$(PYTHONPATH=$place "$bin/python" -c 'import prefect; print(prefect.__version__)')
    if [ "$found" = "$installed" ]; then
        echo "prefect $found is installed: all tests run with it"
        continue
    fi
    echo "prefect $found:"
    PYTHONPATH="$place${PYTHONPATH:+:$PYTHONPATH}" "$bin/python" -m pytest --quiet -p no:xdist \
        tests/flows/server/test_flows.py tests/flows/jobs/test_server_database.py
done
