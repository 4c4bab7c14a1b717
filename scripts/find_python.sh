#!/usr/bin/env bash
# Prints the path of a Python 3.13 that can make virtual environments: from PATH, pyenv, or uv, in that order.
set -uo pipefail

suits() {
  [ -n "$1" ] && "$1" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info[:2] != (3, 13))' >/dev/null 2>&1
}

candidates() {
  for name in python3.13 python3 python; do
    type -aP "$name"
  done
  for python in "$(pyenv root || echo "${PYENV_ROOT:-$HOME/.pyenv}")"/versions/3.13*/bin/python; do
    echo "$python"
  done
  uv python find 3.13 || "$HOME/.local/bin/uv" python find 3.13
}

while IFS= read -r python; do
  if suits "$python"; then
    echo "$python"
    exit 0
  fi
done < <(candidates 2>/dev/null)

echo "Strandscope needs Python 3.13 and found none on PATH, in pyenv or in uv: install it (python.org, \`pyenv install 3.13\` or \`uv python install 3.13\`) and run this again." >&2
exit 1
