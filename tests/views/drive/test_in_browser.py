"""The page of `infgen drive` in a real browser; the server is a process of its own."""

import json
import re
import shutil
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import infgen
from pipeline.api.scoring import LONG_TERM

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed"
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here"),
]
FLAGS = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync")
REPOSITORY = Path(__file__).parents[3]
SCENE = "95dff16c6d8f74e7"
EGO = "(() => { const { step, pose } = drive.driven.last; return [step, ...pose]; })()"


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as browsers:
        started = browsers.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield started
        started.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A running `infgen drive`: its address, and its root."""
    folder = tmp_path_factory.mktemp("drive")
    words = ["drive", SCENE, "--root", str(folder / "root"), "--no-browser"]
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(
            [sys.executable, str(REPOSITORY / "cli.py"), *words],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            cwd=folder,
        ) as process,
    ):
        yield process.stdout.readline().strip(), folder
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 143


@pytest.fixture
def opened(browser, server):
    """``opened(heard=None, **context)``: the page, with the scene begun anew.

    Errors fail the test. Messages of the server are appended to ``heard``.
    """
    faults, contexts = [], []

    def listen(line, heard):
        line.on("framereceived", lambda text: heard.append(json.loads(text)))

    def open_page(heard=None, **more):
        context = browser.new_context(**{"viewport": {"width": 900, "height": 600}, **more})
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on(
            "console",
            lambda said: faults.append(said.text) if said.type == "error" else None,
        )
        if heard is not None:
            page.on("websocket", lambda line: listen(line, heard))
        page.goto(server[0])
        page.wait_for_selector("html[data-ready]", state="attached", timeout=30_000)
        page.evaluate("() => { window.before = drive.message; }")
        page.keyboard.press("Home")
        page.wait_for_function("() => drive.message !== window.before", timeout=30_000)
        page.wait_for_function("() => drive.driven.last && drive.driven.last.step < 16")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not faults


def until(page, step):
    """Wait until the drive has come to a step of the scene."""
    page.wait_for_function(
        "(step) => drive.driven.last && drive.driven.last.step >= step",
        arg=step,
        timeout=90_000,
    )


def of_last_scene(heard):
    """Messages by type since the scene was begun last, each with its number among all."""
    begins = [at for at, message in enumerate(heard) if message["type"] == "scene"]
    found = {"frame": [], "ego": [], "state": []}
    for at, message in enumerate(heard[begins[-1] :]):
        found.setdefault(message["type"], []).append((at, message))
    return found


def test_keys_move_the_ego(opened):
    page = opened()
    start = np.array(page.evaluate(EGO))
    page.keyboard.down("w")
    page.keyboard.down("ArrowLeft")
    until(page, start[0] + 15)
    page.keyboard.up("w")
    page.keyboard.up("ArrowLeft")
    turned = np.array(page.evaluate(EGO))

    assert page.inner_text("#driver") == "you drive"
    assert turned[3] > start[3] + 0.05  # Left is counter-clockwise.
    page.keyboard.down("Space")
    page.wait_for_function("() => drive.driven.last.speed === 0", timeout=60_000)
    page.keyboard.up("Space")
    page.keyboard.press("r")
    page.keyboard.down("ArrowUp")
    page.wait_for_function("() => drive.driven.last.speed < -0.5", timeout=60_000)
    assert page.inner_text("#gear") == "R"


def test_traffic_reacts_to_what_the_ego_does(opened):
    """The same scene and seed: other keys, other positions of others."""
    found = []
    for key in ("ArrowUp", "ArrowDown"):
        page = opened()
        page.keyboard.down(key)
        until(page, 50)
        found.append(
            page.evaluate(
                """() => {
                  const { live } = drive;
                  const cell = (row) => row * live.steps + 45 - live.offset;
                  return [...live.rows].filter(([, row]) => row !== live.ego)
                    .map(([id, row]) => [id, live.x[cell(row)], live.y[cell(row)]]);
                }"""
            )
        )
        page.context.close()

    ahead, braked = ({each[0]: each[1:] for each in places} for places in found)
    both = ahead.keys() & braked.keys()
    assert both
    assert (
        any(ahead[each] != braked[each] for each in both) or ahead.keys() != braked.keys()
    )


def test_agents_enter_and_leave_are_drawn_and_counted(opened):
    page = opened()
    page.wait_for_function(
        "() => drive.state.inserted > 0 && drive.state.removed > 0", timeout=120_000
    )
    page.wait_for_function(
        """() => {
          const [INSERTED] = [2];
          return [...drive.live.rows.values()].some(
            (row) => drive.live.role[row] === INSERTED && drive.pane.poses[row]);
        }""",
        timeout=60_000,
    )
    assert int(page.inner_text("#inserted")) > 0
    assert page.inner_text("#removed")[0] == "\u2212"
    assert re.fullmatch(r"\d+ / \d+ ms", page.inner_text("#steps").strip())


def test_time_goes_on_without_jumps_and_never_backwards(opened):
    page = opened()
    page.keyboard.down("ArrowUp")
    shown = page.evaluate(
        """() => new Promise((done) => {
          const seen = [];
          const look = () => {
            const { x, y } = drive.pane.poses[drive.live.ego];
            seen.push([drive.live.offset + drive.clock.step, x, y]);
            if (seen.length < 150) requestAnimationFrame(look);
            else done(seen);
          };
          requestAnimationFrame(look);
        })"""
    )
    step, x, y = np.array(shown).T

    passed = np.diff(step)
    assert passed.min() >= 0
    way_m, most_m = np.hypot(np.diff(x), np.diff(y)), 35 * 0.1 * passed
    assert (way_m <= most_m + 0.15).all()


def test_a_minute_is_driven_without_a_gap_saved_and_scored(opened):
    """A machine that is busy may be slow here, and the clock may wait for it.

    But no tick, token step or frame is left out or comes too late to be drawn.
    """
    before, heard = [], []
    page = opened(before)
    until(page, 50)
    page.context.close()
    page = opened(heard)
    page.evaluate(
        """() => {
          window.drawn = [];
          const look = () => {
            window.drawn.push(drive.live.offset + drive.clock.step);
            requestAnimationFrame(look);
          };
          requestAnimationFrame(look);
        }"""
    )
    for begin in range(10, 610, 100):  # In a circle, so that traffic stays around.
        page.keyboard.down("ArrowLeft" if begin % 200 == 10 else "ArrowRight")
        page.keyboard.down("ArrowUp")
        until(page, begin + 40)
        page.keyboard.up("ArrowUp")
        page.keyboard.down("ArrowDown")
        until(page, begin + 100)
        for key in ("ArrowLeft", "ArrowRight", "ArrowDown"):
            page.keyboard.up(key)
    page.keyboard.press("c")
    page.wait_for_function("() => drive.page.note.textContent.startsWith('saved')")

    messages = of_last_scene(heard)
    ego_steps = np.array([message["step"] for _, message in messages["ego"]])
    assert ego_steps[0] == 10.25
    assert ego_steps[-1] >= 610
    np.testing.assert_array_equal(np.diff(ego_steps), 0.25)
    frames = {message["token"]: (at, message) for at, message in messages["frame"]}
    assert list(frames) == list(range(2, 2 + len(frames)))
    for at, message in messages["ego"]:
        token = int(np.ceil(message["step"] / 5)) - 1
        assert frames[token][0] < at, f"token step {token} came after its time"
    drawn = np.array(page.evaluate("window.drawn"))
    assert np.diff(drawn).min() >= 0
    assert drawn[-1] >= 609

    # Traffic has changed by the ego's keys, but not before it could see them.
    undriven = {message["token"]: message for _, message in of_last_scene(before)["frame"]}
    assert undriven[2]["path"] == frames[2][1]["path"]
    both = [token for token in undriven if token in frames]
    assert any(undriven[token]["path"] != frames[token][1]["path"] for token in both)
    present = [set(message["id"]) for _, message in frames.values()]
    pairs = list(pairwise(present))
    assert any(after - earlier for earlier, after in pairs)
    assert any(earlier - after for earlier, after in pairs)
    state = messages["state"][-1][1]
    assert state["inserted"] > 0
    assert state["removed"] > 0
    if state["p99"] <= 250:  # Where the world is as fast as promised it is not waited for.
        assert state["late"] * 0.025 < 0.05 * state["seconds"]

    made = infgen.open_rollouts(page.inner_text("#note").removeprefix("saved "))
    assert made[0].num_steps >= made.scene.now + 1 + 595
    reference = infgen.open_reference([made.scene])
    for metric in LONG_TERM:
        assert 0 < made.score(metric, reference=reference)["composite"] <= 1


def test_it_pauses_and_goes_on(opened):
    page = opened()
    page.keyboard.press("p")
    page.wait_for_selector("#stopped:not([hidden])")
    page.wait_for_timeout(300)
    stopped = page.evaluate("drive.driven.last.step")
    page.wait_for_timeout(300)
    assert page.evaluate("drive.driven.last.step") == stopped

    page.click("#pause")
    until(page, stopped + 2)


def test_the_wheel_is_handed_back(opened):
    page = opened()
    page.keyboard.press("n")
    page.wait_for_function("() => drive.state.wheel")
    page.click("#hand")
    page.wait_for_function("() => !drive.state.wheel")
    assert page.inner_text("#driver") == "the network drives"


def test_another_seed_and_another_scene(opened):
    page = opened()
    page.keyboard.press("m")
    page.wait_for_function("() => drive.message.seed === 1", timeout=30_000)
    page.select_option("#scenes", index=1)
    page.wait_for_function("() => drive.message.number === 1", timeout=30_000)
    chosen = page.evaluate("drive.message.scenes[1]")
    assert page.get_attribute("html", "data-ready") == chosen
    page.evaluate("(id) => drive.open(drive.message.scenes.indexOf(id), 0)", SCENE)
    page.wait_for_function("(id) => drive.film.scene === id", arg=SCENE, timeout=30_000)


def test_a_drive_is_saved_and_can_be_viewed(opened, server, tmp_path):
    page = opened()
    page.keyboard.down("ArrowUp")
    until(page, 30)
    page.keyboard.press("c")
    page.wait_for_function("() => drive.page.note.textContent.startsWith('saved')")
    folder = Path(page.inner_text("#note").removeprefix("saved "))

    assert folder.parent == server[1] / "root" / "drives"
    about = json.loads((folder / "manifest.json").read_text())
    assert about["schema"] == "infgen.saved-rollouts/1"
    assert ".tfrecord" in about["drive"]["source"]
    view = [sys.executable, str(REPOSITORY / "cli.py"), "view", str(folder)]
    done = subprocess.run([*view, "--out", str(tmp_path / "x.html")], check=False)
    assert done.returncode == 0


def test_nothing_is_cut_off_on_a_phone(opened):
    page = opened(viewport={"width": 390, "height": 844}, device_scale_factor=2)

    assert page.evaluate("document.documentElement.scrollWidth") == 390
    for name in ("#speed", "#pause", "#hand", "#save", "#scenes", "#seed", "#help", "dl"):
        frame = page.locator(name).first.bounding_box()
        assert frame["x"] >= 0, name
        assert frame["x"] + frame["width"] <= 390, name
        assert frame["y"] + frame["height"] <= 844, name
