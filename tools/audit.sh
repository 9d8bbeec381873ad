#!/usr/bin/env bash
# Looks up known vulnerabilities of every pinned Python dependency. Needs the network: pip-audit asks
# the Python package index for advisories. What cannot be looked up is a failure, not a pass.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

work=out/audit
mkdir -p "$work"
if [ ! -x "$work/venv/bin/pip-audit" ]; then
  python3 -m venv "$work/venv"
  "$work/venv/bin/pip" install --quiet pip-audit==2.10.1
fi
# The wheels of ROS are not on the index; ROS publishes advisories of its own.
cat requirements.txt requirements-dev.txt constraints.txt | sed 's/ *#.*//' |
  grep -E '^[A-Za-z0-9]' | grep -vi '^ros-' | sort -fu >"$work/pinned.txt"
echo "$(wc -l <"$work/pinned.txt") pinned packages: $work/pinned.txt"
"$work/venv/bin/pip-audit" --strict --no-deps --disable-pip --requirement "$work/pinned.txt" "$@"
