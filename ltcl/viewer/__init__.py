# SPDX-License-Identifier: BSD-3-Clause
"""`view`: a page in the browser in which light transport can be touched; `ltcl view` on the command line."""

from __future__ import annotations

import html
import webbrowser
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from ltcl.errors import InputTypeError
from ltcl.transport import Transport, require

LOCAL = "127.0.0.1"


class Viewer:
    """A viewer that runs until `close`, which the end of a with block calls; `url` is its page."""

    def __init__(
        self,
        T: Transport,
        title: str,
        pictures: Mapping[str, np.ndarray] = MappingProxyType({}),
        setup: Any = None,
        *,
        host: str = LOCAL,
        port: int = 0,
    ) -> None:
        try:
            from ltcl.viewer.server import Server
        except ImportError as error:
            raise InputTypeError(f"a viewer needs Starlette ({error}); pip install 'ltcl[view]'") from None
        from ltcl.viewer.answers import Scene

        self._server = Server(Scene(T, title, pictures, setup), host, port)
        self.url, self.is_local = self._server.url, self._server.is_local

    def wait(self) -> None:
        """Until the viewer is closed."""
        self._server.wait()

    def close(self) -> None:
        """End the server; pages say that they lost it."""
        self._server.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ltcl Viewer at {self.url}>"

    def _repr_html_(self) -> str:
        return f'<iframe src="{html.escape(self.url)}" style="width:100%;height:720px;border:0"></iframe>'


def view(
    T: Transport,
    picture: Any = None,
    *,
    host: str = LOCAL,
    port: int = 0,
    open_browser: bool = True,
) -> Viewer:
    """Show T in the browser."""
    viewer = Viewer(require(T, square=False), repr(T)[1:-1], host=host, port=port)
    if open_browser:
        webbrowser.open(viewer.url)
    return viewer
