"""All faults: what every module of this folder that is called `*_faults` lists as `FAULTS`."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from pathlib import Path

from faults.fault import Fault


def modules() -> list[str]:
    """Names of the modules with faults."""
    files = Path(__file__).parent.glob("*_faults.py")
    return sorted(f"faults.{file.stem}" for file in files if not file.stem.startswith("test_"))


def every_fault(names: Iterable[str] | None = None) -> list[Fault]:
    """The faults of some modules, by default of all.

    Raises:
        ValueError: when two faults have one name, or do one thing.
    """
    faults: dict[str, Fault] = {}
    injected: dict[str, str] = {}
    for name in modules() if names is None else names:
        for fault in importlib.import_module(name).FAULTS:
            if fault.name in faults:
                raise ValueError(f"two faults are called {fault.name}")
            if fault.injected in injected:
                raise ValueError(f"{fault.name} and {injected[fault.injected]} inject one thing")
            faults[fault.name] = fault
            injected[fault.injected] = fault.name
    return list(faults.values())


def home_of(fault: Fault) -> str:
    """Name of the module that lists a fault."""
    return next(name for name in modules() if fault in importlib.import_module(name).FAULTS)
