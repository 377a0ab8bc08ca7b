"""The site that `make docs` builds, as a person sees it: search, pictures, and no page wider than a telephone."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

SITE = Path(__file__).parents[2] / "build/site"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """Nothing on stderr."""


@pytest.mark.slow  # a browser: make test-browser
@pytest.mark.skipif(not (SITE / "index.html").exists(), reason="no site: make docs builds it")
def test_the_site_reads_well_and_is_searched(browser):
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(SITE)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    root = f"http://127.0.0.1:{server.server_port}/"
    pages = [p.relative_to(SITE) for p in SITE.rglob("*.html") if p.name != "404.html"]
    try:
        browser.open(f"{root}index.html")
        browser.until("getComputedStyle(document.querySelector('.md-search')).display !== 'none'")
        browser.js(
            "document.querySelector('#__search').click(); const i = document.querySelector('.md-search__input'); i.focus();"
            "i.value = 'second encoder'; i.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true})); 1"
        )
        browser.until(
            "[...document.querySelectorAll('.md-search-result__link')].some(a => a.href.includes('second-encoder'))"
        )
        for width in (1280, 360):
            browser.size(width, 900)
            for page in sorted(pages):
                browser.open(f"{root}{page}")
                browser.until("document.readyState === 'complete'")
                assert browser.js("document.documentElement.scrollWidth <= innerWidth"), (page, width)
                assert browser.js("[...document.images].every(i => i.naturalWidth)"), page
                outside = (
                    "performance.getEntriesByType('resource').every(r => r.name.startsWith(location.origin))"
                )
                assert browser.js(outside), f"{page} takes nothing from elsewhere"
    finally:
        server.shutdown()
