#!/usr/bin/env bash
# Prepares this checkout: system packages if they are missing (Linux only), then .venv with the package installed in
# editable mode. Usage: scripts/setup.sh [EXTRAS], EXTRAS as in pyproject.toml (default: dev). Changes nothing, within a
# second or so, when pyproject.toml and constraints.txt are as they were at the last successful run.
#
# PYTHON                   interpreter for .venv (default: the first suitable of python3, python3.12, python3.11)
# SAFESWITCH_SKIP_SYSTEM=1 go on without the system packages (no rendering, or a slower expert)
set -euo pipefail
cd "$(dirname "$0")/.."

extras="${1:-dev}"
venv=.venv
debian=()   # Debian packages that are missing
reasons=()  # and what each is for

say() { printf '[set-up] %s\n' "$*" >&2; }
die() { say "$@"; exit 1; }

find_python() {
  local candidate
  for candidate in ${PYTHON:-python3 python3.12 python3.11}; do
    if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
  die "SafeSwitch needs Python 3.11 or 3.12; tried: ${PYTHON:-python3 python3.12 python3.11}." \
    "Name one with: make PYTHON=/path/to/python3.12 ..."
}

# A C compiler and the C library's headers: the expert's solver is generated C.
compiler_works() {
  local folder status=0
  folder=$(mktemp -d)
  echo '#include <math.h>
double f(double x) { return sqrt(x); }' > "$folder/probe.c"
  "${CC:-cc}" -shared -fPIC -o "$folder/probe.so" "$folder/probe.c" -lm >/dev/null 2>&1 \
    || gcc -shared -fPIC -o "$folder/probe.so" "$folder/probe.c" -lm >/dev/null 2>&1 || status=1
  rm -rf "$folder"
  return $status
}

# EGL as MuJoCo opens it: some device must give a display that can be initialised, which libEGL alone does not, and
# PyOpenGL, through which MuJoCo calls EGL, wants libOpenGL or libGL beside it.
egl_works() {
  "$1" - <<'PROBE' >/dev/null 2>&1
import ctypes, sys
from ctypes.util import find_library
egl = ctypes.CDLL("libEGL.so.1")
pointer, count = ctypes.c_void_p, ctypes.c_int()
egl.eglGetProcAddress.restype = pointer
egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(egl.eglGetProcAddress(b"eglQueryDevicesEXT"))
display = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT"))
egl.eglInitialize.argtypes = [pointer, pointer, pointer]
devices = (pointer * 16)()
query(16, devices, ctypes.byref(count))
opened = (display(0x313F, device, None) for device in devices[: count.value])  # EGL_PLATFORM_DEVICE_EXT
works = any(each and egl.eglInitialize(each, None, None) for each in opened)
sys.exit(not (works and (find_library("OpenGL") or find_library("GL"))))
PROBE
}

probe_linux() {
  if [ ! -x "$venv/bin/python" ] && ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    debian+=(python3-venv); reasons+=("virtual environments")
  fi
  if [ "${SAFESWITCH_SKIP_SYSTEM:-0}" = 1 ]; then return; fi
  if ! compiler_works; then debian+=(gcc libc6-dev); reasons+=("compiling the expert's solver"); fi
  case "$extras" in *perf*) # crocoddyl's side of the comparison is C++
    if ! command -v g++ >/dev/null; then debian+=(g++); reasons+=("compiling crocoddyl's model"); fi ;;
  esac
  case "$extras" in *browser*) # the tests of the report drive one
    if ! command -v chromium >/dev/null || ! command -v chromedriver >/dev/null; then
      debian+=(chromium chromium-driver); reasons+=("tests of the report in a browser")
    fi ;;
  esac
  if [ "${MUJOCO_GL:-egl}" = egl ] && ! egl_works "$python"; then
    debian+=(libegl1 libgl1-mesa-dri libopengl0); reasons+=("rendering without a display (EGL)")
  fi
}

install_debian() {
  local command=(apt-get -o DPkg::Lock::Timeout=300)
  if ! command -v apt-get >/dev/null; then
    die "missing: $(IFS=';'; echo "${reasons[*]}"). This is no Debian: install what provides Debian's packages" \
      "${debian[*]} (or set SAFESWITCH_SKIP_SYSTEM=1 to go on without rendering and compiler)."
  fi
  if [ "$(id -u)" = 0 ]; then
    command=(env DEBIAN_FRONTEND=noninteractive "${command[@]}")
  elif sudo -n true 2>/dev/null; then
    command=(sudo -n env DEBIAN_FRONTEND=noninteractive "${command[@]}")
  else
    die "missing: $(IFS=';'; echo "${reasons[*]}"). Run this, then try again (or set SAFESWITCH_SKIP_SYSTEM=1 to go" \
      "on without rendering and compiler):
    sudo apt-get update && sudo apt-get install -y --no-install-recommends ${debian[*]}"
  fi
  say "installing Debian packages: ${debian[*]}"
  # Quiet but for errors, which apt-get writes to standard error. A package source of the machine's that does not
  # answer need not matter to us.
  "${command[@]}" update -qq >/dev/null || say "apt-get update failed: going on with the package lists that are there"
  "${command[@]}" install -y -qq --no-install-recommends "${debian[@]}" >/dev/null \
    || die "apt-get failed. Once it works again, as root: apt-get update && apt-get install -y ${debian[*]}"
}

install_python_packages() {
  if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    say "creating $venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
  fi
  say "installing Python packages into $venv (a few minutes the first time)"
  local quiet=--quiet
  if [ -t 2 ]; then quiet=; fi # someone is watching: show the downloads
  "$venv/bin/python" -m pip install $quiet --disable-pip-version-check -c constraints.txt -e ".[$extras]" >&2
}

python=$(find_python)
if [ "$(uname -s)" = Linux ]; then
  probe_linux
  if [ ${#debian[@]} -gt 0 ]; then install_debian; fi
elif ! compiler_works && [ "${SAFESWITCH_SKIP_SYSTEM:-0}" != 1 ]; then
  die "no working C compiler. On macOS run: xcode-select --install (or set SAFESWITCH_SKIP_SYSTEM=1)"
fi

# The folder is part of the stamp: a virtual environment that was moved does not work and is made again.
stamp="$venv/.installed-$extras"
wanted="$(cat pyproject.toml constraints.txt | cksum)
$PWD"
if [ ! -x "$venv/bin/python" ] || [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]; then
  if ls "$venv"/.installed-* >/dev/null 2>&1 && ! grep -qxF "$PWD" "$venv"/.installed-*; then rm -rf "$venv"; fi
  install_python_packages
  echo "$wanted" > "$stamp"
  say "done"
fi
