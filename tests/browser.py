"""Helpers for tests of pages in the browser that ``conftest.py`` starts."""

import time


def wait_until(browser, script, seconds=20):
    """Wait until a script returns a true value, and return it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := browser.execute_script(f"return {script}"):
            return value
        time.sleep(0.05)
    raise AssertionError(f"never true: {script}; console: {browser.get_log('browser')}")


def errors(browser):
    return [entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
