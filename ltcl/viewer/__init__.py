# SPDX-License-Identifier: BSD-3-Clause
"""`view`: light transport in the browser or a notebook; `ltcl view` on the command line."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, overload

from ltcl import checks
from ltcl.errors import InputError
from ltcl.transport.transport import Transport, check_transport

if TYPE_CHECKING:
    from ltcl.viewer.server import Viewer
    from ltcl.viewer.widget import ViewerWidget

WAYS = ("auto", "browser", "notebook")


@overload
def view(
    T: Transport,
    picture: Any = None,
    *,
    how: Literal["notebook"],
    setup: Any = None,
    title: str = "",
) -> ViewerWidget: ...


@overload
def view(
    T: Transport,
    picture: Any = None,
    *,
    how: Literal["auto", "browser"] = "auto",
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    origin: str = "",
    setup: Any = None,
    title: str = "",
) -> Viewer: ...


def view(
    T: Transport,
    picture: Any = None,
    *,
    how: Literal["auto", "browser", "notebook"] = "auto",
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    origin: str = "",
    setup: Any = None,
    title: str = "",
) -> Viewer | ViewerWidget:
    """Show T in the browser: probe it, separate bounces, relight, compensate; feed a projector.

    In a notebook it is a widget below the cell, wherever the kernel runs; elsewhere a server of
    this machine shows a page.

    Parameters
    ----------
    T : Transport
    picture : array or dict of arrays, optional
        Linear light (h, w[, 3]), or a dict of such pictures by names, to compensate for, separate
        or relight with. Those of other proportions than the grid are cropped, until Fit on the page
        says otherwise.
    how : {"auto", "browser", "notebook"}
        A page of a server, or a widget of a notebook, which needs the extra `notebook` and opens no
        port. "auto" takes the widget where a notebook runs, unless one of the next four arguments
        is given, which are for a server.
    host, port : str, int
        Address of the page; by default a free port of this machine. Beyond this machine whoever has
        the URL can look and compute. A page of a viewer that ended finds the next one on the same
        port.
    open_browser : bool
        Whether to open the page in the browser.
    origin : str
        URL at which the browser finds the page behind a proxy or on a forwarded port, such as
        "http://localhost:9000" or "https://hub.example.org/user/me/proxy/8123"; other addresses
        than this one and the viewer's own are refused.
    setup : ltcl.acquisition.Setup, optional
        Measured projector of T, whose codes projector windows then show; else they show sRGB.
    title : str
        Title of the page.

    Returns
    -------
    Viewer or ViewerWidget
        Either has `close()`, which frees what it holds, and is a context manager. A Viewer has the
        `url` of its page; a ViewerWidget is a widget of ipywidgets. A notebook shows both.

    Raises
    ------
    InputError
        The address is not available, `origin` is no URL, an argument of a server is given to a
        widget, or the extra `view` or `notebook` is not installed.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(4, albedo=0.5).transport()
    >>> with ltcl.view(T, how="browser", open_browser=False) as viewer:
    ...     viewer.url.startswith("http://127.0.0.1:")
    True
    """
    checks.one_of("how", how, WAYS)
    check_transport(T, square=False)
    address = {"host": host, "port": port, "open_browser": open_browser, "origin": origin}
    own_address = _own_address(address)
    if how == "auto":
        is_widget = not own_address and _is_notebook()
        how = "notebook" if is_widget else "browser"
    if how == "notebook" and own_address:
        name, value = own_address
        raise InputError(f"{name} is {value!r}; it is for how='browser' only")
    pictures = {}
    if isinstance(picture, Mapping):
        pictures = picture
    elif picture is not None:
        pictures = {"picture": picture}
    if not title:
        title = repr(T).strip("<>")
    return _show(how, T, title, pictures, setup, address)


def _show(
    how: str,
    T: Transport,
    title: str,
    pictures: Mapping[str, Any],
    setup: Any,
    address: dict[str, Any],
) -> Viewer | ViewerWidget:
    """Import what the way needs, then show the scene."""
    from ltcl.viewer.answers import ViewerScene

    if how == "notebook":
        from ltcl.viewer.widget import ViewerWidget

        return ViewerWidget(ViewerScene(T, title, pictures, setup))
    from ltcl.viewer.server import Viewer

    return Viewer(ViewerScene(T, title, pictures, setup), **address)


def _own_address(address: dict[str, Any]) -> tuple[str, Any] | None:
    """Return the first argument of a server that is not the default, with its name."""
    defaults = {"host": "127.0.0.1", "port": 0, "open_browser": True, "origin": ""}
    for name, value in address.items():
        if value != defaults[name]:
            return name, value
    return None


def _is_notebook() -> bool:
    """True if a kernel runs this Python, one of IPython or marimo."""
    ipython = sys.modules.get("IPython")
    if ipython is not None:
        shell = ipython.get_ipython()
        if getattr(shell, "kernel", None) is not None:
            return True
    marimo = sys.modules.get("marimo")
    return marimo is not None and marimo.running_in_notebook()
