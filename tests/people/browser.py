"""A headless Chromium on a pipe (DevTools protocol): opens a page, evaluates, presses keys, takes pictures."""

import base64
import json
import os
import select
import shutil
import subprocess
import time

LIMIT_S = 120.0
PICTURES = os.environ.get(
    "THERMOCTL_PICTURES"
)  # a folder that keeps the screenshots (make pictures: docs/images)


def find():
    """The browser's program, or None."""
    return next(
        (p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome")) if p), None
    )


class Browser:
    """One browser with one page. `messages` are what the page wrote to its console, errors included."""

    def __init__(self, program, folder, width=1440, height=1000):
        to_browser, our_write = os.pipe()
        our_read, from_browser = os.pipe()
        self.write_fd, self.read_fd, self.received, self.number, self.messages = (
            our_write,
            our_read,
            b"",
            0,
            [],
        )

        def place_pipes():  # the protocol's pipes are descriptors 3 and 4
            a, b = os.dup(to_browser), os.dup(from_browser)
            os.dup2(a, 3)
            os.dup2(b, 4)

        self.process = subprocess.Popen(
            [
                program,
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--no-first-run",
                "--disable-extensions",
                "--disable-background-networking",
                "--force-color-profile=srgb",
                f"--user-data-dir={folder}",
                f"--window-size={width},{height}",
                "--remote-debugging-pipe",
                "about:blank",
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=place_pipes,
            close_fds=False,
        )
        os.close(to_browser)
        os.close(from_browser)
        self.session = None
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self.session = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setScrollbarsHidden", hidden=True)
        self.size(width, height)

    def call(self, method, **parameters):
        """One command of the protocol and its result."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write_fd, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + LIMIT_S + 30.0  # `until` gives up first, and says what it waited for
        while True:
            answer = self._next(deadline)
            if answer.get("id") == self.number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self._note(answer)

    def _next(self, deadline):
        while b"\0" not in self.received:
            ready, _, _ = select.select([self.read_fd], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, f"the browser gave no answer within {LIMIT_S} s"
            data = os.read(self.read_fd, 1 << 20)
            assert data, "the browser ended"
            self.received += data
        message, _, self.received = self.received.partition(b"\0")
        return json.loads(message)

    def _note(self, event):
        kind, about = event.get("method"), event.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.messages.append(
                "exception: " + json.dumps(about["exceptionDetails"].get("exception", about))[:500]
            )
        elif kind == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.messages.append("log: " + about["entry"]["text"])
        elif kind == "Runtime.consoleAPICalled" and about["type"] == "error":
            self.messages.append("console: " + json.dumps(about["args"])[:500])

    def open(self, url):
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def js(self, expression):
        """The value of an expression in the page (promises are awaited)."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, (expression, answer["exceptionDetails"])
        return answer["result"].get("value")

    def until(self, expression, limit_s=LIMIT_S):
        """The first true value of an expression, looked at on every animation frame; fails after limit_s."""
        value = self.js(f"""new Promise(done => {{ const end = performance.now() + {limit_s * 1e3};
            (function look() {{ let v = null; try {{ v = ({expression}); }} catch (e) {{ v = null; }}
              if (v || performance.now() > end) done(v); else setTimeout(look, 20); }})(); }})""")
        assert value, f"not within {limit_s} s: {expression}; {self.messages}"
        return value

    def key(self, key, shift=False, code=None):
        """Press and release one key, as 'Tab', 'ArrowLeft', 'Enter'."""
        codes = {
            "Tab": 9,
            "Enter": 13,
            " ": 32,
            "ArrowLeft": 37,
            "ArrowRight": 39,
            "Home": 36,
            "End": 35,
            "ArrowDown": 40,
        }
        more = {"text": "\r"} if key == "Enter" else {}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=code or key,
                windowsVirtualKeyCode=codes[key],
                modifiers=8 if shift else 0,
                **(more if kind == "keyDown" else {}),
            )

    def dark(self, dark):
        """What the person's system prefers."""
        self.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}],
        )

    def size(self, width, height):
        """The window's size in pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def picture(self, path, height=None):
        """The whole page, or its upper `height` pixels, as PNG."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        shot = self.call(
            "Page.captureScreenshot",
            format="png",
            captureBeyondViewport=True,
            clip={"x": 0, "y": 0, "width": size["width"], "height": height or size["height"], "scale": 1},
        )
        with open(path, "wb") as f:
            f.write(base64.b64decode(shot["data"]))

    def keep(self, name, height=None):
        """The picture as NAME.png, in 250 colours: small enough to live in the repository. Only where PICTURES is set."""
        if PICTURES:
            from PIL import Image

            path = os.path.join(PICTURES, f"{name}.png")
            os.makedirs(PICTURES, exist_ok=True)
            self.picture(path, height)
            Image.open(path).convert("RGB").quantize(250, dither=Image.Dither.NONE).save(path, optimize=True)

    def close(self):
        """End it."""
        self.process.kill()
        self.process.wait()
        os.close(self.write_fd)
        os.close(self.read_fd)
