"""The web server of the viewer's page, closed to those it is not meant for."""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import logging
import socket
from urllib.parse import urlsplit

import viser
from viser.infra import WebsockClientConnection

from meslam_core.errors import ConfigError

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
POLICY_VIOLATION = 1008

logger = logging.getLogger(__name__)


class PageServer(viser.ViserServer):
    """viser's server on one address; it opens no way to itself from elsewhere.

    Other sites' pages, which a browser lets connect to this computer too, get nothing: the page
    must come from here, and under this computer's own name where the server is bound to it alone.

    Args:
        host: address to listen on; 0.0.0.0 for all of this computer.
        port: the next free one from this on is taken; 0 for any.

    Raises:
        ConfigError: when the address is not this computer's.
    """

    def __init__(self, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT) -> None:
        self._only_local = _check_address(host)
        self._host = host
        # It prints where it listens, which is said better elsewhere.
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host, port, label="MeSLAM", verbose=False)
        self._websock_server.on_client_connect(self._admit)

    @property
    def url(self) -> str:
        """Of the page, as seen from this computer."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self._host, self._host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.get_port()}"

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused: viser would offer the page to everybody through a server on the internet."""
        logger.warning("a viewer's request to publish the page on the internet was refused")
        return None

    def stop(self) -> None:
        """Close the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()

    async def _admit(self, client: WebsockClientConnection) -> None:
        """Turn away a browser that shows a page of another site."""
        connection = self._websock_server._live_connections[client.client_id]
        request = connection.request
        host = "" if request is None else request.headers.get("Host", "")
        origin = None if request is None else request.headers.get("Origin")
        if not is_own_page(host, origin, self._only_local):
            logger.warning("a page of %s that wanted to see the map was refused", origin or host)
            await connection.close(POLICY_VIOLATION, "pages of other sites are not served")


def is_own_page(host: str, origin: str | None, only_local: bool) -> bool:
    """Whether a browser's connection comes from the page that this server sent.

    Args:
        host: header of the request, which names the server as the browser does.
        origin: header that tells whose page connects; programs send none.
        only_local: whether the server listens for this computer alone. A name that is not this
            computer's was then made to point here by somebody else.
    """
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    return not only_local or _is_loopback(urlsplit(f"//{host}").hostname or "")


def _is_loopback(name: str) -> bool:
    if name == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def _check_address(host: str) -> bool:
    """Whether an address is reached from this computer alone.

    Raises:
        ConfigError: when it is none of this computer's addresses.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise ConfigError(
                f"the viewer cannot listen on {host!r} ({error.strerror}); give an address of this "
                "computer: 127.0.0.1 for this computer alone, 0.0.0.0 for its network too"
            ) from error
    return ipaddress.ip_address(address[0]).is_loopback
