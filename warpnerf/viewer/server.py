"""The web server of the viewer: viser's, with checks of who connects.

A server on 127.0.0.1 can be reached by every page in the browsers of this machine. So whoever
connects must have requested this machine by a name of its own, and a page must come from here.
"""

from __future__ import annotations

import functools
import logging
import socket
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from warpnerf.checks import InputError, require_extra

if TYPE_CHECKING:
    import viser

PORT = 8080
"""That is tried first where none is named."""

MAX_MESSAGE_BYTES = 1 << 20
"""From a page; all that it has to say are a few numbers."""


def open_server(host: str, port: int | None) -> viser.ViserServer:
    """Serve a page to those who may see it; silently.

    Args:
        host: Name or address of this machine to listen at.
        port: None: ``PORT``, or the next one that is free; 0: any that is free.

    Raises:
        InputError: viser is missing, or host and port cannot be listened at.
    """
    require_extra("viser", "viewer", "the viewer")
    require_place(host, port)
    import viser
    import websockets.asyncio.server

    serve = websockets.asyncio.server.serve
    guards = []

    @functools.wraps(serve)
    def guarded(*arguments: Any, process_request: Any, max_size: int, **options: Any) -> Any:
        guards.append(_guard(host, process_request))
        return serve(*arguments, process_request=guards[-1], max_size=MAX_MESSAGE_BYTES, **options)

    # viser has no setting for this; while it starts, what it calls is replaced.
    websockets.asyncio.server.serve = guarded
    try:
        with _silence():
            server = viser.ViserServer(
                host=host, port=PORT if port is None else port, verbose=False
            )
    finally:
        websockets.asyncio.server.serve = serve
    if not guards:
        close_server(server)
        raise InputError(
            f"viser {viser.__version__} cannot be told whom to let in; install another version of "
            'it: pip install "warpnerf[viewer]".'
        )
    # Else any page could have it serve the world, through a machine of others.
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    # Who sends garbage is disconnected. There is nothing to say about it.
    for name in ("websockets", "websockets.server"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    server.get_event_loop().set_exception_handler(lambda loop, context: None)
    return server


def close_server(server: viser.ViserServer) -> None:
    """End it, silently."""
    with _silence():
        server.stop()


def address(server: viser.ViserServer) -> str:
    """Where the page is, for a browser on this machine or another."""
    host = server.get_host()
    if host in ("0.0.0.0", "::", ""):
        host = socket.gethostname()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def may_enter(headers: Any, names: set[str]) -> bool:
    """Whether a request is for this machine and, if a page makes it, for that page's own server.

    A page from elsewhere has another origin. A name that a stranger has pointed at this machine is
    none of its own; addresses cannot be pointed anywhere.

    Args:
        headers: Of the request, a ``websockets.Headers``.
        names: Of this machine, in small letters.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return False
    host = hosts[0].lower()
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    if name not in names and not _is_address(name):
        return False
    return not origins or urlsplit(origins[0].lower()).netloc == host


def _guard(host: str, inner: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Refuse unknown hosts and origins before anything else."""
    names = {host.lower(), "localhost", socket.gethostname().lower(), socket.getfqdn().lower()}

    def guard(connection: Any, request: Any) -> Any:
        try:
            welcome = may_enter(request.headers, names)
        except ValueError:  # an origin that is no address
            welcome = False
        if not welcome:
            return connection.respond(
                HTTPStatus.FORBIDDEN, "Open this page by an address of the machine it is on.\n"
            )
        if not _is_page(request.headers):
            return connection.respond(HTTPStatus.BAD_REQUEST, "Open this page in a browser.\n")
        return inner(connection, request)

    return guard


def _is_page(headers: Any) -> bool:
    """Whether a request is for a file, or for a socket as viser's page requests it.

    viser would print a line about each other one: a port scan has many.
    """
    if headers.get_all("Upgrade") == []:
        return True
    offered = ",".join(headers.get_all("Sec-WebSocket-Protocol")).split(",")
    return any(protocol.strip().startswith("viser-v") for protocol in offered)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def require_place(host: str, port: int | None) -> None:
    """Refuse what cannot be listened at, where viser would try for ever.

    Args:
        host: As of ``open_server``.
        port: Likewise.

    Raises:
        InputError: There is no such place here, or somebody else is there.
    """
    port = 0 if port is None else port
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port} is none; choose one of 1 to 65535, or 0 for any.")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, _, _, _, place in found:
            with socket.create_server(place, family=family):
                pass
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        named, way_out = f"--host {host}", "leave it out for 127.0.0.1"
        if port:
            named += f" --port {port}"
            way_out = "choose another port, 0 for any, or 127.0.0.1"
        raise InputError(f"{named} cannot be listened at: {reason}; {way_out}.") from None


@contextmanager
def _silence() -> Iterator[None]:
    """Without viser's own announcements, which it prints by rich."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
