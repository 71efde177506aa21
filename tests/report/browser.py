"""A headless Chromium, driven through its DevTools protocol over two pipes: real clicks and keys, nothing to install.

https://chromedevtools.github.io/devtools-protocol/ has the commands; a message is JSON and a zero byte.
"""

import fcntl
import json
import os
import select
import shutil
import subprocess
import time

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SECONDS = 60
KEYS = {"Enter": (13, "\r"), " ": (32, " "), "Tab": (9, ""), "Backspace": (8, ""), "Escape": (27, "")}


def executable():
    """The path of a Chromium; None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One tab. ``errors`` gathers what its console complains of, ``addresses`` what was asked for."""

    def __init__(self, profile):
        self.count, self.events, self.errors, self.buffer = 0, [], [], b""
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        theirs = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (theirs_in, theirs_out)]   # not 3 or 4 by chance
        os.close(theirs_in), os.close(theirs_out)

        def give():                                                # Chromium reads from 3 and writes to 4
            os.dup2(theirs[0], 3)
            os.dup2(theirs[1], 4)

        self.process = subprocess.Popen(
            [executable(), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
             "--hide-scrollbars", "--remote-debugging-pipe", f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(3, 4), preexec_fn=give, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for end in theirs:
            os.close(end)
        self.reading, self.writing, self.session, self.addresses = ours_in, ours_out, None, []
        tab = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=tab, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(SECONDS)
        os.close(self.reading), os.close(self.writing)

    def send(self, method, **parameters):
        """The result of a command."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.writing, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self.count:
            self._notice(answer)
        assert "error" not in answer, (method, answer["error"])
        return answer["result"]

    def open(self, url):
        """Load a page to its end."""
        self.events.clear()
        self.send("Page.navigate", url=url)
        self._loaded()

    def js(self, expression):
        """The value of an expression on the page."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def click(self, selector, *, loads=False):
        """Scroll to what is selected and click into its middle, wherever the page has it; it may load another page."""
        self.events.clear()
        x, y = self.js(f"""(() => {{ const it = document.querySelector({json.dumps(selector)});
            it.scrollIntoView({{block: "center", inline: "center", behavior: "instant"}});
            const box = it.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]; }})()""")
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        if loads:
            self._loaded()

    def press(self, key):
        """Press and release a key."""
        code, text = KEYS[key]
        shared = {"key": key, "code": "Space" if key == " " else key, "windowsVirtualKeyCode": code}
        self.send("Input.dispatchKeyEvent", type="keyDown", text=text, **shared)
        self.send("Input.dispatchKeyEvent", type="keyUp", **shared)

    def type(self, text):
        """Put text where the focus is."""
        self.send("Input.insertText", text=text)

    def wait(self, expression):
        """Until it is true."""
        end = time.monotonic() + SECONDS
        while not self.js(expression):
            assert time.monotonic() < end, expression
            time.sleep(0.02)

    def size(self, width, height=900):
        """Of the window, in px."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def prefer(self, **features):
        """Media features, such as prefers_color_scheme="dark"."""
        self.send("Emulation.setEmulatedMedia", features=[
            {"name": name.replace("_", "-"), "value": value} for name, value in features.items()])

    def _loaded(self):
        while "Page.loadEventFired" not in self.events:
            self._notice(self._next())

    def _notice(self, message):
        method, parameters = message.get("method"), message.get("params", {})
        self.events.append(method)
        if method == "Runtime.exceptionThrown":
            self.errors.append(parameters["exceptionDetails"]["text"])
        elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
            self.errors.append(str(parameters["args"]))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(parameters["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.addresses.append(parameters["request"]["url"])

    def _next(self):
        """The next message."""
        while b"\0" not in self.buffer:
            assert select.select([self.reading], [], [], SECONDS)[0], "the browser says nothing any more"
            chunk = os.read(self.reading, 1 << 16)
            assert chunk, "the browser is gone"
            self.buffer += chunk
        message, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(message)
