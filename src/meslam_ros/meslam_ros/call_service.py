"""`call_service`: calls a service from a shell; for machines without the `ros2` command line.

call_service                                            lists the services
call_service /meslam/list_regions
call_service /meslam/export_map "{path: room.ply}"
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from meslam_core.errors import MeslamError
from meslam_ros.client import MeslamClient

DISCOVERY_S = 10.0
SETTLING_S = 2.0
SHOWN_ENTRIES = 10
REFUSED, USAGE_ERROR = 1, 2


class CallError(MeslamError):
    """A call that cannot be made: no such service, or a request that does not fit it."""


def interface(name: str) -> Any:
    """The class of an interface by its name, `package/srv/Name` or `package/Name` (a message)."""
    package, *kind, name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind[0] if kind else 'msg'}"), name)


def fill(message: Any, values: Any) -> Any:
    """Set a message's fields from nested mappings and lists, as YAML gives them.

    Raises:
        CallError: naming the field that does not exist, or whose value does not fit.
    """
    kinds = message.get_fields_and_field_types()
    if not isinstance(values, Mapping):
        raise CallError(f"expected {{{', '.join(kinds)}}}, got {values!r}")
    for name, value in values.items():
        if name not in kinds:
            raise CallError(f"there is no field {name}; there are {', '.join(kinds)}")
        try:
            setattr(message, name, _value(kinds[name], value))
        except (TypeError, ValueError, OverflowError) as error:
            raise CallError(f"{name} is {kinds[name]}, which {value!r} does not fit") from error
    return message


def _value(kind: str, value: Any) -> Any:
    """A value of a field; rclpy itself does not look at what it is given."""
    element = re.match(r"sequence<([^,>]+)|([\w/]+)\[", kind)
    if element is not None:
        if not isinstance(value, list):
            raise ValueError
        return [_value(element[1] or element[2], entry) for entry in value]
    if "/" in kind:
        return fill(interface(kind)(), value)
    if kind in ("float", "double"):
        return float(value)
    if kind.startswith("string"):
        return str(value)
    if type(value) is not (bool if kind == "boolean" else int):
        raise ValueError
    return value


def shown(message: Any) -> Any:
    """A message as nested mappings for people; long arrays are shortened."""
    if hasattr(message, "get_fields_and_field_types"):
        names = message.get_fields_and_field_types()
        return {name: shown(getattr(message, name)) for name in names}
    if isinstance(message, np.generic):
        return message.item()
    if isinstance(message, (str, bool, int, float)):
        return message
    entries = [shown(entry) for entry in list(message[:SHOWN_ENTRIES])]
    hidden = len(message) - len(entries)
    return [*entries, f"... and {hidden} more"] if hidden > 0 else entries


def succeeded(response: Any) -> bool:
    """Whether an answer says so: `result` 0, or `success`; true where it says neither."""
    return getattr(response, "result", 0) == 0 and bool(getattr(response, "success", True))


def services(client: MeslamClient) -> dict[str, str]:
    """Type of every service that is there, by its name, but for those every node has."""
    found = client.node.get_service_names_and_types()
    return {
        name: kinds[0]
        for name, kinds in found
        if not kinds[0].startswith(("rcl_interfaces/", "type_description_interfaces/"))
    }


def call(client: MeslamClient, name: str, request: str, timeout_s: float) -> Any:
    """Call a service with a request in YAML.

    Raises:
        CallError: when there is no such service, or the request does not fit.
        TimeoutError: when it does not answer in time.
    """
    name = client.node.resolve_service_name(name)
    if not client.spin_until(lambda: name in services(client), DISCOVERY_S):
        known = ", ".join(sorted(services(client))) or "none"
        raise CallError(f"there is no service {name}; there are: {known}")
    kind = interface(services(client)[name])
    return client.call(kind, name, request_of(kind, request), timeout_s)


def request_of(kind: Any, text: str) -> Any:
    """The request to a service of a kind, its fields given in YAML.

    Raises:
        CallError: when the text is no YAML, or does not fit.
    """
    try:
        values = yaml.safe_load(text) or {}
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise CallError(f"the request is no YAML: {error}") from error
    return fill(kind.Request(), values)


def run(arguments: Sequence[str], show: Callable[[str], object] = print) -> int:
    """Do what a command line asks; the exit status."""
    parser = argparse.ArgumentParser("call_service", description="Call a ROS service.")
    parser.add_argument("name", nargs="?", help="of the service; without it, all are listed")
    parser.add_argument("request", nargs="?", default="{}", help="its fields in YAML")
    parser.add_argument("--timeout", type=float, default=120.0, help="for the answer [s]")
    given = parser.parse_args(arguments)
    with MeslamClient("call_service") as client:
        try:
            if given.name is None:
                client.spin_until(lambda: bool(services(client)), DISCOVERY_S)
                # One node's services may be known before another's.
                client.spin_until(lambda: False, SETTLING_S)
                for name, kind in sorted(services(client).items()):
                    show(f"{name}  {kind}")
                return 0
            response = call(client, given.name, given.request, given.timeout)
        except (MeslamError, TimeoutError) as error:
            print(f"error: {error}", file=sys.stderr)
            return USAGE_ERROR
        show(yaml.safe_dump(shown(response), sort_keys=False, allow_unicode=True).rstrip())
        return 0 if succeeded(response) else REFUSED


def main() -> None:
    """Entry point."""
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
