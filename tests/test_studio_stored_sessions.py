"""Sessions of the studio server continue after a reload or a crash."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("websockets", reason="the extra studio is not installed")

from websockets.exceptions import ConnectionClosed

from quasiharmonic.ui.studio import server as served
from quasiharmonic.ui.studio.protocol import encode
from shared.studio_server import children, hear, nobody_is_left, session_page


@pytest.mark.slow
def test_a_session_continues_after_a_reload_and_after_a_crash(running):
    name = "0123456789abcdef" * 2
    with session_page(running, name) as page:
        hear(page, "map", state="settled")
        page.send(encode({"do": "outline", "to": "disk"}))
        shown = hear(page, "map", state="settled")
        hear(page, "obstructions")
        page.send(encode({"do": "stop"}))
        hear(page, "obstructions")
    with session_page(running, name) as page:
        again = hear(page, "map", state="settled")
        assert again.header["outline"] == "disk"
        assert again.header["undo"]
        assert np.array_equal(again.arrays["places"], shown.arrays["places"])
        for process in children():
            process.kill()
        assert hear(page, "note").header["level"] == "gone"
    with session_page(running, name) as page:
        assert hear(page, "map", state="settled").header["outline"] == "disk"
        page.send(encode({"do": "undo"}))
        assert hear(page, "map", state="settled").header["outline"] == "rect:1x1"
    nobody_is_left()


@pytest.mark.slow
def test_a_session_opened_elsewhere_ends_here(running):
    name = "f" * 32
    with session_page(running, name) as one:
        hear(one, "map", state="settled")
        with session_page(running, name) as other:
            hear(other, "map", state="settled")
            with pytest.raises(ConnectionClosed) as closed:
                hear(one, "never")
            assert closed.value.rcvd.code == served.ELSEWHERE


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "../../etc",
        *(pytest.param(name, marks=pytest.mark.nightly) for name in ("A" * 32, "0" * 31, "0" * 64, "%2e%2e")),
    ],
)
def test_names_of_sessions_are_not_paths(running, name):
    with session_page(running, name) as one:
        assert hear(one, "map", state="settled").header["injective"]
        # A second page with this name does not take over a session of the first.
        with session_page(running, name) as other:
            hear(other, "map", state="settled")
            assert one.ping().wait(60)
