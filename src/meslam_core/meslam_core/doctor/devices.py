"""What a person uses: a RealSense camera, and a browser for the viewer."""

from __future__ import annotations

import importlib
import os
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from meslam_core.doctor.finding import Finding, ok, warn

USB_DEVICES = Path("/sys/bus/usb/devices")
RULES = (Path("/etc/udev/rules.d"), Path("/usr/lib/udev/rules.d"), Path("/lib/udev/rules.d"))
INTEL, REALSENSE = "8086", ("0a", "0b")
UDEV_REMEDY = (
    "let users open it: put librealsense's config/99-realsense-libusb.rules into "
    "/etc/udev/rules.d, run `sudo udevadm control --reload-rules && sudo udevadm trigger`, and "
    "plug the camera in again"
)
CONTAINER_REMEDY = (
    "in a container, start it with `--device-cgroup-rule 'c 81:* rmw' "
    "--device-cgroup-rule 'c 189:* rmw' -v /dev:/dev`"
)


def examine_devices() -> Iterator[Finding]:
    """The camera, and a screen."""
    yield from cameras(realsense_devices, plugged_in(USB_DEVICES), has_rules(RULES))
    yield browser(os.environ, _has_browser())


def realsense_devices() -> list[tuple[str, str]]:
    """Name and USB version of every camera that librealsense can open.

    Raises:
        ImportError: when pyrealsense2 is missing.
    """
    realsense: Any = importlib.import_module("pyrealsense2")
    info = realsense.camera_info
    return [
        (device.get_info(info.name), device.get_info(info.usb_type_descriptor))
        for device in realsense.context().query_devices()
        if device.supports(info.usb_type_descriptor)
    ]


def plugged_in(folder: Path) -> int:
    """How many RealSense devices the USB bus shows, whether or not they can be opened."""
    count = 0
    for vendor in folder.glob("*/idVendor"):
        try:
            product = (vendor.parent / "idProduct").read_text().strip()
            count += vendor.read_text().strip() == INTEL and product.startswith(REALSENSE)
        except OSError:
            continue
    return count


def has_rules(folders: Sequence[Path]) -> bool:
    """Whether librealsense's udev rules are installed."""
    return any(any(folder.glob("*realsense*.rules")) for folder in folders)


def cameras(
    opened: Callable[[], list[tuple[str, str]]], on_bus: int, rules: bool
) -> Iterator[Finding]:
    """Every camera, or why there is none.

    Args:
        opened: lists name and USB version of what librealsense can open.
        on_bus: how many the USB bus shows.
        rules: udev lets users open them.
    """
    try:
        found = opened()
    except ImportError as error:
        remedy = "run `python -m pip install pyrealsense2`; recordings of other kinds work without"
        yield warn("camera", f"pyrealsense2 cannot be loaded: {error}", remedy)
        return
    except RuntimeError as error:
        yield warn("camera", f"librealsense cannot look for cameras: {error}", UDEV_REMEDY)
        return
    for name, usb in found:
        if usb.startswith("3"):
            yield ok("camera", f"{name}, USB {usb}")
        else:
            remedy = "use a USB 3 port and the cable that came with the camera"
            yield warn("camera", f"{name}, USB {usb}: too slow for colour and depth", remedy)
    if on_bus > len(found):
        told = f"{on_bus} on USB, of which librealsense opens {len(found)}"
        remedy = CONTAINER_REMEDY if rules else f"{UDEV_REMEDY}; {CONTAINER_REMEDY}"
        yield warn("camera", told, remedy)
    elif not found:
        yield ok("camera", "no RealSense is connected; recordings work without")


def browser(environment: Mapping[str, str], there: bool) -> Finding:
    """Whether the viewer's page can be seen on this computer."""
    screen = any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if there and screen:
        return ok("browser", "there is one for `meslam view`")
    missing = "no browser" if screen else "no screen"
    return ok(
        "browser",
        f"{missing} here; open the page of `meslam view` from another computer: "
        "`ssh -L 8080:localhost:8080 THIS_COMPUTER`, then http://localhost:8080 there",
    )


def _has_browser() -> bool:
    try:
        webbrowser.get()
    except webbrowser.Error:
        return False
    return True
