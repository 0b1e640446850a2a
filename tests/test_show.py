"""The demo's page is opened where there is a display, and its path told where there is none."""

import webbrowser

import pytest

from pickplace.show import show


@pytest.mark.parametrize("display", ["", ":0"])
def test_show(display, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    page = tmp_path / "a page.html"
    with pytest.raises(FileNotFoundError, match="no such page"):
        show(page)
    page.write_text("<p>hello")
    text = show(page)
    assert opened == ([page.as_uri()] if display else [])
    assert ("Opened" if display else str(page)) in text
