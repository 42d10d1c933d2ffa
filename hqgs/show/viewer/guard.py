"""A viser server for this machine alone.

viser answers every page that finds it: it has no setting for the pages that may speak to it, takes messages
of 50 MB, and a client can ask it to open a tunnel to a server elsewhere. Here it hears on 127.0.0.1, refuses
pages of another origin and names of other hosts (a page elsewhere whose name was made to point here), takes
messages of 1 MiB, and opens no tunnel.
"""

from __future__ import annotations

import http
import io
import re
import threading
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import wraps
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import viser

HOST, PORT = "127.0.0.1", 8080
MAX_MESSAGE = 1 << 20  # bytes; what a page of ours sends takes hundreds
# Words for those whose browser is not on this machine: a container, a remote editor, a notebook in a cloud.
ELSEWHERE = (
    "To see it on another machine, forward the port under the same number: "
    "`ssh -L {port}:localhost:{port} HOST`; VS Code: the tab Ports; Docker: run with `--network host`, then "
    "as for HOST; JupyterHub and Colab: no page of another origin may speak to this one: send report.html "
    "instead, which needs no server."
)
REFUSED = (
    "This page answers http://localhost:{port} and http://127.0.0.1:{port} only, so that no other page and "
    "no other machine can read it.\n" + ELSEWHERE + "\n"
)
_OURS = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
_patching = threading.Lock()


def allowed(host: str | None, origin: str | None) -> bool:
    """Whether a request for this host, from a page of this origin (None: from no page), may be answered."""
    if host is None or not _OURS.fullmatch(host):
        return False
    return origin is None or origin == f"http://{host}"


def check(port: int) -> None:
    """ValueError where viser, the extra `view`, is not installed, or the port is none; loads nothing."""
    if not 0 <= port <= 65535:
        raise ValueError(f"port is {port}, wanted 0..65535")
    if find_spec("viser") is None:
        raise ValueError("the viewer needs viser, the extra 'view': pip install 'hqgs[view]'")


def start_server(port: int = PORT, label: str = "hqgs") -> viser.ViserServer:
    """Start the server; it takes the next free port from `port` on, and any for 0.

    Raises:
        ValueError: as `check`.
        RuntimeError: this version of viser cannot be guarded.
    """
    check(port)
    import viser
    import websockets.asyncio.server as sockets
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    class LocalServer(viser.ViserServer):
        """No page leaves this machine."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    guarded = False
    serve = sockets.serve

    def guarded_serve(*arguments: Any, **options: Any) -> Any:
        nonlocal guarded
        guarded = True
        answer: Callable[[Any, Any], Any] = options["process_request"]

        @wraps(answer)
        def checked(connection: Any, request: Any) -> Any:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            single = len(hosts) == 1 and len(origins) <= 1
            if not single or not allowed(hosts[0], origins[0] if origins else None):
                address = getattr(connection, "local_address", None)
                text = REFUSED.format(port=int(address[1]) if address else PORT).encode()
                headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(text))})
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)
            return answer(connection, request)

        return serve(*arguments, **{**options, "process_request": checked, "max_size": MAX_MESSAGE})

    # viser starts its thread, which calls `serve`, while it is made, and returns once that has happened.
    with _patching:
        sockets.serve = guarded_serve  # type: ignore[assignment]
        try:
            with redirect_stdout(io.StringIO()):  # for its banner, which nothing turns off
                server = LocalServer(host=HOST, port=port, label=label, verbose=False)
        finally:
            sockets.serve = serve
    if not guarded:
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} starts in a way that hqgs cannot guard")
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    return server
