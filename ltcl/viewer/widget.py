# SPDX-License-Identifier: BSD-3-Clause
"""`ViewerWidget`: the viewer as a widget of a notebook, over the kernel's own channel.

The page is the one of the server (`page_files`), and so are its questions and their answers
(`client`). No port is opened.
"""

from __future__ import annotations

import base64
import uuid
from typing import Any

from ltcl import checks
from ltcl.errors import InputError
from ltcl.viewer import page_files
from ltcl.viewer.kernel_pages import KernelPages
from ltcl.viewer.still import draw_still

try:
    import anywidget
    import traitlets
except ImportError as error:
    user = "a viewer in a notebook"
    raise InputError(checks.missing_extra("anywidget", "notebook", user, error)) from None

# The picture after the widget. Either is hidden, by whether the widget has made its element NAME.
# The first two rules are for JupyterLab, and hide the whole output with its margins.
STILL_OUTPUT = """<style>
.jp-OutputArea-child:has(+ .jp-OutputArea-child .NAME-still):not(:has(.NAME)),
.jp-OutputArea-child:has(.NAME) + .jp-OutputArea-child:has(.NAME-still),
:root:has(.NAME) .NAME-still { display: none; }
</style>
<img class="NAME-still" alt="The viewer as it begins" src="data:image/png;base64,PNG">"""


class ViewerWidget(anywidget.AnyWidget):
    """A viewer in a notebook, until `close`, the end of a with block, or that of the kernel.

    Each place that shows it is a page of its own. A minute after the last of them is gone it holds
    no transport, so that one which nobody else has kept is freed. Saved notebooks keep `still`, a
    picture of the view as it begins.
    """

    _esm = page_files.widget_module()
    still = traitlets.Bytes(help="The view as it begins, a PNG.").tag(sync=True)
    name = traitlets.Unicode(help="What the viewer's element is called, by a class.").tag(sync=True)

    def __init__(self, scene: Any) -> None:
        self.title = scene.title
        self._pages = KernelPages(scene, self._give)
        super().__init__(still=draw_still(scene), name=f"ltcl-{uuid.uuid4().hex}")
        self.on_msg(self._take)

    def close(self) -> None:
        """Close the viewer everywhere, and let go of the transport."""
        self._pages.close()
        super().close()

    def __enter__(self) -> ViewerWidget:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ltcl viewer of {self.title}: how='browser' shows it where no widgets are>"

    def _repr_mimebundle_(self, **options: Any) -> Any:
        """Return the widget, and a picture for where it is not alive."""
        bundle = super()._repr_mimebundle_(**options)
        if bundle is None:
            return None
        data, metadata = bundle
        return {**data, **self._still_bundle()}, metadata

    def _ipython_display_(self) -> None:
        """Show the widget, and after it a picture, of which one is in sight.

        One output would not do: JupyterLab prefers the widget, and shows an error in its place in a
        saved notebook without a kernel.
        """
        from IPython.display import display

        bundle = super()._repr_mimebundle_()
        if bundle is None:
            return
        display(bundle[0], metadata=bundle[1], raw=True)
        still = self._still_bundle()
        if still:
            png = still["image/png"]
            html = STILL_OUTPUT.replace("NAME", self.name).replace("PNG", png)
            display({**still, "text/html": html, "text/plain": repr(self)}, raw=True)

    def _still_bundle(self) -> dict[str, str]:
        if not self.still:
            return {}
        return {"image/png": base64.b64encode(self.still).decode()}

    def _take(self, _: Any, content: Any, buffers: Any) -> None:
        """Take a message of the front end."""
        parts = [] if buffers is None else [bytes(buffer) for buffer in buffers]
        self._pages.take(content, parts)

    def _give(self, content: dict[str, Any], buffers: list[bytes]) -> None:
        """Give a message to the front end; from any thread."""
        if self.comm is not None:
            self.send(content, buffers)
