#!/usr/bin/env bash
# Sets everything up in .venv and runs all checks: lint, format, types, tests on all cores.
# Arguments go to pytest, such as: scripts/run_tests.sh tests/sim -k stall
# --quick as the first argument runs only the unit tests that take seconds; they use every package (tests/levels.py).
# EXTRAS=dev,rigs adds the firmware's rig; scripts/install_rigs.sh installs what it needs beyond pip.
set -euo pipefail
cd "$(dirname "$0")/.."

cores="$(nproc 2>/dev/null || echo 2)"
selection=()
if [ "${1:-}" = --quick ]; then
  shift
  selection=(-m "unit and not slow")
fi
[ -x .venv/bin/python ] || python3 -m venv .venv
.venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".[${EXTRAS:-dev}]"
.venv/bin/ruff check .
.venv/bin/ruff format --check .
.venv/bin/python scripts/generate_protocol.py --check
# Without stored bytecode each program that a test starts would compile the package again.
unset PYTHONDONTWRITEBYTECODE
# Threads of BLAS in addition to the workers would wait for one another on matrices of a hundred rows.
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
# A session syncs its file to the disk with each commit. In memory nobody waits for that: it takes 2 GB of 4, and programs
# have to run from there.
free_kb="$(df -Pk /dev/shm 2>/dev/null | awk 'NR == 2 { print $4 }')"
if [ -z "${TMPDIR:-}" ] && [ "${free_kb:-0}" -gt 4000000 ] && ! grep -q ' /dev/shm .*noexec' /proc/mounts; then
  TMPDIR="$(mktemp -d /dev/shm/adis-gonio-XXXXXX)"
  chmod 755 "$TMPDIR"  # tests of rights read their files as another user
  export TMPDIR
  in_memory="$TMPDIR"
fi
# The types are checked while the tests run; both have to pass.
types="$(mktemp)"
.venv/bin/mypy >"$types" 2>&1 &
checker=$!
trap 'rm -rf "$types" ${in_memory:+"$in_memory"}; kill "$checker" 2>/dev/null || true' EXIT
# In a fresh clone each worker would compile the tests, which takes longer than to import them: it is done once.
[ -d tests/__pycache__ ] || .venv/bin/pytest --collect-only -qq ${selection[@]+"${selection[@]}"} "$@" >/dev/null 2>&1 || true
# Some tests wait for programs and clocks, so twice as many workers as cores keep the cores busy.
# A worker that has run its tests takes half of the tests that another one still has.
status=0
.venv/bin/pytest -n $((2 * cores)) --dist worksteal ${selection[@]+"${selection[@]}"} "$@" || status=$?
wait "$checker" || status=1
cat "$types"
exit "$status"
