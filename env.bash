# Sets up a bash shell for MeSLAM:  source env.bash
# Afterwards `meslam`, rclpy, the interfaces and the nodes work; sourcing it again is harmless.

_meslam_env() {
  local root venv ros_prefix dir
  root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)"
  venv="$root/.venv"
  if [ ! -f "$venv/ros_prefix" ] || [ ! -f "$root/install/local_setup.bash" ]; then
    echo "env.bash: MeSLAM is not set up yet; run 'make setup' in $root first" >&2
    return 1
  fi

  ros_prefix="$(cat "$venv/ros_prefix")"
  if [ "$ros_prefix" != "$venv" ] && [ "${ROS_DISTRO:-}" != jazzy ]; then
    # shellcheck disable=SC1091
    source "$ros_prefix/setup.bash" || return 1
  fi
  if [ "${VIRTUAL_ENV:-}" != "$venv" ] || [[ ":$PATH:" != *":$venv/bin:"* ]]; then
    # shellcheck disable=SC1091
    source "$venv/bin/activate" || return 1
  fi

  if [ "$ros_prefix" = "$venv" ]; then
    export ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy
    _meslam_prepend AMENT_PREFIX_PATH "$venv"
    _meslam_prepend CMAKE_PREFIX_PATH "$venv"
    _meslam_prepend LD_LIBRARY_PATH "$venv/lib"
    for dir in "$venv"/lib/python3.*/site-packages/ros_*.libs; do
      _meslam_prepend LD_LIBRARY_PATH "$dir"
    done
    # The wheels would start every Python twice to set the library path that is set above.
    export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
    # There is no `ros2 run`: the nodes are commands of their own.
    _meslam_prepend PATH "$root/install/meslam_ros/lib/meslam_ros"
  fi

  # shellcheck disable=SC1091
  source "$root/install/local_setup.bash" || return 1

  # Images need a larger shared-memory segment than Fast DDS gives; a user's own profile stays.
  if [ "${FASTRTPS_DEFAULT_PROFILES_FILE:-}" = "${_MESLAM_FASTDDS_PROFILE:-}" ]; then
    _MESLAM_FASTDDS_PROFILE="$root/config/fastdds.xml"
    export _MESLAM_FASTDDS_PROFILE FASTRTPS_DEFAULT_PROFILES_FILE="$_MESLAM_FASTDDS_PROFILE"
  fi
}

# _meslam_prepend NAME DIR: put DIR at the front of the path variable NAME unless it is in it.
_meslam_prepend() {
  local name="$1" dir="$2"
  case ":${!name:-}:" in
    *":$dir:"*) ;;
    *) export "$name=$dir${!name:+:${!name}}" ;;
  esac
}

# The scripts of ROS and colcon read unset variables; the caller's `set -u` is restored after them.
_meslam_options="$-"
set +u
_meslam_env && _meslam_status=0 || _meslam_status=$?
case "$_meslam_options" in *u*) set -u ;; esac
unset -f _meslam_env _meslam_prepend
unset _meslam_options
# Returns the status and leaves no variable behind.
eval "unset _meslam_status; return $_meslam_status"
