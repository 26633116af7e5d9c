#!/usr/bin/env bash
# Builds the documentation site into build/site; a warning is an error. Needs the extra docs.
# Arguments go to sphinx-build, such as: scripts/build_docs.sh --fresh-env
set -euo pipefail
cd "$(dirname "$0")/.."

.venv/bin/sphinx-build --quiet --fail-on-warning --jobs auto "$@" --conf-dir docs . "${SITE:-build/site}"
echo "${SITE:-build/site}/index.html"
