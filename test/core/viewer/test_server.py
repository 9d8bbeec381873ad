"""Who may see the page, and where it is served."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from meslam_core.errors import ConfigError
from meslam_core.viewer.server import PageServer, is_own_page

WAIT_S = 30.0


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    server = PageServer(port=0)
    server.gui.add_text("Secret", "map")
    yield server
    server.stop()


def connection(server: PageServer, origin: str | None) -> ClientConnection:
    return connect(
        server.url.replace("http", "ws"),
        origin=None if origin is None else Origin(origin),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        open_timeout=WAIT_S,
    )


def test_it_listens_for_this_computer_alone_unless_told_otherwise(server: PageServer) -> None:
    assert server.url == f"http://127.0.0.1:{server.get_port()}"
    assert server.get_host() == "127.0.0.1"


def test_the_own_page_is_served(server: PageServer) -> None:
    with connection(server, server.url) as own:
        assert own.recv(timeout=WAIT_S)


def test_another_sites_page_gets_nothing(server: PageServer) -> None:
    with connection(server, "http://elsewhere.example") as other, pytest.raises(ConnectionClosed):
        assert other.recv(timeout=WAIT_S) is None


@pytest.mark.parametrize(
    ("host", "origin", "only_local", "own"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True, True),
        ("localhost:8080", "http://localhost:8080", True, True),
        ("[::1]:8080", "http://[::1]:8080", True, True),
        ("localhost:8080", None, True, True),
        ("localhost:8080", "http://localhost:9000", True, False),
        ("localhost:8080", "https://elsewhere.example", True, False),
        ("localhost:8080", "null", True, False),
        ("rebound.example:8080", "http://rebound.example:8080", True, False),
        ("robot.local:8080", "http://robot.local:8080", False, True),
        ("robot.local:8080", "http://elsewhere.example", False, False),
        ("", None, True, False),
    ],
)
def test_own_pages_are_told_from_others(host, origin, only_local, own) -> None:
    assert is_own_page(host, origin, only_local) == own


def test_nobody_can_publish_the_page_on_the_internet(server: PageServer) -> None:
    assert server.request_share_url() is None


def test_a_port_that_is_taken_is_passed_over(server: PageServer) -> None:
    second = PageServer(port=server.get_port())
    assert second.get_port() > server.get_port()
    second.stop()


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_an_address_of_another_computer_is_refused(host: str) -> None:
    with pytest.raises(ConfigError, match=r"cannot listen.*127\.0\.0\.1"):
        PageServer(host, 0)
