#!/usr/bin/env bash
# Sets up what is missing, then hands everything to `python -m lifelong_lib` (default command: run).
#   LIFELONG_PYTHON=/path/to/python   use that interpreter, which has every package already, and set nothing up
set -euo pipefail
self="${BASH_SOURCE[0]}"
while [ -L "$self" ]; do   # called through a link: the folder is that of the file it leads to
    next="$(readlink "$self")"
    case "$next" in /*) self="$next" ;; *) self="$(dirname "$self")/$next" ;; esac
done
root="$(cd "$(dirname "$self")" && pwd)"
cd "$root"

fail() { echo "error: $*" >&2; exit 2; }

[ -f environment.txt ] && [ -d lifelong_lib ] || fail "$root is not the project's folder: environment.txt is missing there"

is_recent() { [ "$("$1" -c 'import sys; print(sys.version_info >= (3, 11))' 2>/dev/null)" = True ]; }

find_python() {   # pybullet has ready-made wheels for 3.11 only, so 3.11 is tried first
    local name
    for name in python3.11 python3 python python3.12 python3.13; do
        if is_recent "$name"; then
            echo "$name"
            return
        fi
    done
    fail "no Python 3.11 or newer found; install one, or name it in LIFELONG_PYTHON"
}

set_up() {   # the copy of environment.txt is written last, so an interrupted install is noticed and repeated
    local lock=.venv/installed.txt python
    if [ -x .venv/bin/python ] && cmp -s environment.txt "$lock"; then
        return
    fi
    echo "setting up .venv from environment.txt (a few minutes, only when that file changed)" >&2
    rm -f "$lock"
    if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then   # none, or one that was made without pip
        [ ! -e .venv ] || [ -f .venv/pyvenv.cfg ] || fail "$root/.venv is no virtual environment; move it away"
        python="$(find_python)" || exit $?
        rm -rf .venv
        "$python" -m venv .venv || fail "could not make .venv with $python; is its venv module installed (on Debian: python3-venv)?"
    fi
    .venv/bin/python -m pip install --quiet --no-input --disable-pip-version-check -r environment.txt \
        || fail "pip could not install environment.txt (see above); the same command tries again"
    cp environment.txt "$lock.part"
    mv "$lock.part" "$lock"
}

python="${LIFELONG_PYTHON:-.venv/bin/python}"
if [ -z "${LIFELONG_PYTHON:-}" ]; then
    set_up
elif ! command -v "$python" >/dev/null; then
    fail "LIFELONG_PYTHON=$python is not a program"
elif ! is_recent "$python"; then
    fail "LIFELONG_PYTHON=$python is no Python, or older than 3.11; 3.11 or newer is needed"
fi

export PYTHONHASHSEED=0 PYTHONUTF8=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 NUMEXPR_NUM_THREADS=1
export PYTHONPATH="$root"   # other programs' packages (ROS, SUMO's tools) stay outside
unset PYTHONHOME PYTHONSTARTUP
case "${1:-}" in
    -h | --help) ;;
    "" | -*) set -- run "$@" ;;
esac
exec "$python" -m lifelong_lib "$@"
