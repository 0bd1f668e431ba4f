#!/usr/bin/env bash
# Makes .venv ready: Debian packages, Python, the pinned packages. Run again at will; it does only what is missing.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=.venv
stamp=$venv/.ready

say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }

# The stamp holds what the environment was made from, so that it is made anew when that changes.
wanted=$(cat pyproject.toml constraints.txt scripts/setup.sh | cksum)
if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ] && "$venv/bin/python" -c '' 2>/dev/null; then
  exit 0
fi

# Open3D needs libusb and libgomp; OpenCV and pycolmap need libGL; Habitat-Sim would need EGL.
libraries="libusb-1.0.so.0:libusb-1.0-0 libgomp.so.1:libgomp1 libEGL.so.1:libegl1 libGL.so.1:libgl1"
missing=
for pair in $libraries; do
  if ! PATH=$PATH:/sbin:/usr/sbin ldconfig -p | grep -qF "${pair%%:*}"; then missing="$missing ${pair##*:}"; fi
done
install_packages() {  # packages...
  local command="apt-get update && apt-get install -y --no-install-recommends $*"
  local failure="missing system libraries; run, then try again:  sudo sh -c '$command'"
  if ! command -v apt-get >/dev/null; then say "missing system libraries:$*; install them with this system's package manager"; exit 1; fi
  if [ "$(id -u)" = 0 ]; then
    say "installing Debian packages: $*"
    DEBIAN_FRONTEND=noninteractive sh -c "$command" >&2 || { say "$failure"; exit 1; }
  elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    say "installing Debian packages with sudo: $*"
    sudo -n env DEBIAN_FRONTEND=noninteractive sh -c "$command" >&2 || { say "$failure"; exit 1; }
  else
    say "$failure"; exit 1
  fi
}
if [ -n "$missing" ]; then
  # shellcheck disable=SC2086
  install_packages $missing
fi

# The first of these that runs and is 3.11 or 3.12 (a pyenv shim may exist and still not run).
python=
for candidate in ${PYTHON:-} python3 python3.12 python3.11; do
  if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; then
    python=$candidate; break
  fi
done
if [ -z "$python" ]; then
  say "found no Python 3.11 or 3.12; install one, or name it:  make setup PYTHON=/path/to/python3.12"; exit 1
fi
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then install_packages python3-venv; fi

if ! "$venv/bin/python" -c '' 2>/dev/null; then
  say "making $venv with $("$python" --version)"
  rm -rf "$venv"
  "$python" -m venv "$venv"
fi
rm -f "$stamp"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --constraint constraints.txt uv
say "installing the pinned packages (about 9 GB with torch's CUDA libraries; a minute or more)"
# Compiled now, because with PYTHONDONTWRITEBYTECODE set every program would compile torch and MLflow anew.
"$venv/bin/uv" pip install --quiet --compile-bytecode --python "$venv/bin/python" --constraint constraints.txt --editable '.[dev]'
printf '%s' "$wanted" > "$stamp"
say "ready: $venv"
