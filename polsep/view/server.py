"""The viewer's server: for this machine only by default, with temporary folders, without requests to others."""

from __future__ import annotations

import os
import socket
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from polsep.io.store.temporary import make_temporary_folders, remove_folder
from polsep.methods import find_method
from polsep.sensor.camera import Layout, Mosaic
from polsep.view.guard import LOOPBACK, Guard
from polsep.view.sessions import Sessions
from polsep.view.style import CSS, FONTS, MONOSPACE, ON_LOAD

#: Upload limit: 24 frames of 2448x2048 in 16 bits.
MAX_MB = 240
#: Addresses that mean all addresses of a machine.
ANY_HOST = ("0.0.0.0", "::")


@dataclass(frozen=True)
class ViewOptions:
    """The viewer's address and first state: ``settings`` by the names of `opening.parse_settings`.

    ``port`` None: the first free one from 7860 on. ``most_mb``: of an upload.
    """

    host: str = LOOPBACK[0]
    port: int | None = None
    file: Path | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    most_mb: int = MAX_MB


@contextmanager
def serve(options: ViewOptions) -> Iterator[str]:
    """Serve the viewer inside the block and yield its address.

    Raises ModuleNotFoundError without Gradio, and ValueError where it cannot listen to the address.
    """
    if find_spec("gradio") is None:
        raise ModuleNotFoundError("No module named 'gradio'", name="gradio")
    require_address(options.host, options.port)
    scratch = make_temporary_folders()
    kept = {name: os.environ.get(name) for name in _environment(scratch.root)}
    os.environ.update(_environment(scratch.root))
    page, sessions = None, Sessions(scratch, options.most_mb << 20)
    warm = threading.Thread(target=warm_up, args=(options.settings.get("method", "auto"),))
    warm.start()
    try:
        page = _build(options, sessions)
        yield _launch(page, options)
    finally:
        if page is not None and page.is_running:
            page.close(verbose=False)
        warm.join()  # the program must not end while a network is compiled
        sessions.close()
        remove_folder(scratch.root)
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def require_address(host: str, port: int | None) -> None:
    """Raise ValueError where this machine has no such address, or another program has the port."""
    try:
        family, kind, _, _, place = socket.getaddrinfo(plain_host(host), port or 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            if os.name == "posix":  # elsewhere it would share the port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except (OSError, UnicodeError) as error:
        at = host if port is None else f"{host}, port {port}"
        reason = getattr(error, "strerror", None) or "no name of a machine"
        raise ValueError(f"expected an address of this machine and a free port, found {at}: {reason}") from None


def plain_host(host: str) -> str:
    """The address without the brackets that addresses with colons have in a browser."""
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host


def _environment(root: Path) -> dict[str, str]:
    """Environment variables for Gradio: no analytics, and all its files below ``root``."""
    return {
        "GRADIO_ANALYTICS_ENABLED": "False",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_OFFLINE": "1",
        "GRADIO_TEMP_DIR": str(root / "exchange"),
        "GRADIO_EXAMPLES_CACHE": str(root / "kept" / "examples"),
    }


def _build(options: ViewOptions, sessions: Sessions):  # type: ignore[no-untyped-def]  # Gradio has no types for us
    """Build the page; imports Gradio only here, as that takes seconds and its dependencies warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from polsep.view.components import Start
        from polsep.view.page import build_page

        return build_page(sessions, Start(options.settings, options.file))


def _launch(page, options: ViewOptions) -> str:  # type: ignore[no-untyped-def]
    import gradio as gr

    host = plain_host(options.host)
    hosts = None if host in ANY_HOST else (*LOOPBACK, host.lower())
    most_bytes = options.most_mb << 20
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, address, _ = page.launch(
            server_name=f"[{host}]" if ":" in host else host,
            server_port=options.port,
            prevent_thread_lock=True,
            inbrowser=False,
            share=False,
            quiet=True,
            show_error=False,
            footer_links=[],
            run_history=False,
            ssr_mode=False,
            pwa=False,
            mcp_server=False,
            enable_monitoring=False,
            allowed_paths=[],
            max_file_size=most_bytes,
            state_session_capacity=256,
            theme=gr.themes.Base(primary_hue="blue", neutral_hue="zinc", font=FONTS, font_mono=MONOSPACE),
            css=CSS,
            js=ON_LOAD,
            app_kwargs={
                "middleware": [(Guard, (), {"hosts": hosts, "most_bytes": most_bytes})],
                "docs_url": None,
                "redoc_url": None,
                "openapi_url": None,
            },
        )
    return str(address)


def warm_up(method: str) -> None:
    """Load kernels and weights, and build an engine of the usual size, before the first separation."""
    mosaic = Mosaic(np.zeros((2048, 2448), np.float32), Layout(), 0.0, 1.0)
    find_method(method, mosaic).run(mosaic, (1.0, 1.0, 1.0), False)
