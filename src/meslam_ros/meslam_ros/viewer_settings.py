"""What the viewer node can be told."""

from __future__ import annotations

from dataclasses import dataclass

from meslam_core.setting import setting


@dataclass
class ViewerSettings:
    """Parameters of the viewer alone."""

    host: str = setting(
        "127.0.0.1",
        "address that the page is served on; the default is for this computer alone, 0.0.0.0 for "
        "its network too: everybody there can then see and download the map",
    )
    port: int = setting(
        8080,
        "port of the page; if it is taken, the next free one; 0 for any",
        minimum=0,
        maximum=65535,
    )
    mesh_resolution_m: float = setting(
        0.04,
        "spacing of the mesh's vertices at first; regions in training are shown more coarsely",
        unit="m",
        minimum=0.01,
        maximum=0.2,
    )
