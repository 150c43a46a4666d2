"""The player in a real browser, without a screen."""

import base64
import shutil

import numpy as np
import pytest

from infgen.views.player import player_page
from infgen.views.scene.interpolation import moment_at
from infgen.views.scene.view_model import make_view_model
from tests.exports.replays import replay, with_newcomer

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed"
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
FLAGS = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as browsers:
        started = browsers.chromium.launch(
            executable_path=CHROMIUM,
            args=[*FLAGS, "--disable-background-networking", "--disable-component-update"],
        )
        yield started
        started.close()


@pytest.fixture(scope="module")
def file(view_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("player") / "film.html"
    path.write_text(player_page(view_model))
    return path


@pytest.fixture
def opened(browser, file):
    """``opened(hash="t=0", **context)``: the page, ready; errors fail the test."""
    faults, contexts = [], []

    def open_page(hash_="t=0", path=file, **more):
        context = browser.new_context(
            **{"viewport": {"width": 1200, "height": 800}, **more}
        )
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on(
            "console",
            lambda said: faults.append(said.text) if said.type == "error" else None,
        )
        page.on(
            "request",
            lambda asked: (
                faults.append(asked.url)
                if not asked.url.startswith(("file:", "data:"))
                else None
            ),
        )
        page.goto(f"{path.as_uri()}#{hash_}")
        page.wait_for_selector("html[data-ready]", state="attached", timeout=20_000)
        settle(page)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not faults


def settle(page):
    """Let two frames go by."""
    page.evaluate(
        "() => new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))"
    )


def time_of(page):
    return page.evaluate("player.clock.time")


def pixels(page, at=0):
    """The picture of a pane, as bytes of RGBA."""
    text = page.evaluate(
        """(at) => {
          const { canvas, context } = player.panes[at];
          const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
          let text = "";
          for (const value of data) text += String.fromCharCode(value);
          return btoa(text);
        }""",
        at,
    )
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(-1, 4)


def colour(page, name):
    text = page.evaluate("(name) => player.colours[name]", name)
    return np.array([int(text[at : at + 2], 16) for at in (1, 3, 5)])


def test_all_is_read_as_python_packed_it(opened, view_model):
    page = opened()

    found = page.evaluate(
        """() => player.film.showings.map((each) => ({
          name: each.name, x: [...each.x], y: [...each.y], heading: [...each.heading],
          there: [...each.there], first: [...each.first], present: [...each.present],
        }))"""
    )

    for showing, read in zip(view_model.showings, found, strict=True):
        valid = showing.valid
        assert read["name"] == showing.name
        assert read["present"] == valid.sum(axis=0).tolist()
        assert read["first"] == showing.first_step.tolist()
        np.testing.assert_array_equal(np.reshape(read["there"], valid.shape), valid)
        for axis, name in enumerate("xy"):
            values = np.reshape(read[name], valid.shape)
            np.testing.assert_allclose(
                values[valid], showing.pose[..., axis][valid], atol=0.01
            )
        turned = np.reshape(read["heading"], valid.shape) - showing.pose[..., 2]
        np.testing.assert_allclose(np.cos(turned[valid]), 1, atol=1e-4)


def test_it_plays_from_now_when_opened(opened):
    page = opened(hash_="")

    page.wait_for_function("() => player.clock.time > 0.3", timeout=5000)
    assert page.get_attribute("#play", "aria-pressed") == "true"


def test_it_stays_still_for_those_who_want_less_motion(opened):
    page = opened(hash_="", reduced_motion="reduce")

    assert time_of(page) == 0
    assert page.get_attribute("#play", "aria-pressed") == "false"


def test_the_space_bar_plays_and_stops(opened):
    page = opened()
    page.keyboard.press("Space")
    page.wait_for_function("() => player.clock.time > 0.2", timeout=5000)
    page.keyboard.press("Space")
    settle(page)

    stopped = time_of(page)
    page.wait_for_timeout(150)
    assert time_of(page) == stopped


def test_at_twice_the_speed_time_runs_twice_as_fast(opened):
    page = opened()

    advanced = page.evaluate(
        """() => {
          const { clock } = player;
          clock.speed = 2;
          clock.toggle();
          clock.advance(1000);
          clock.advance(1050);
          clock.toggle();
          return clock.time;
        }"""
    )

    assert advanced == pytest.approx(0.1)


def test_it_stops_at_the_end_and_starts_over(opened):
    page = opened(hash_="t=7.9")
    page.keyboard.press("Space")
    page.wait_for_function("() => !player.clock.playing", timeout=5000)
    assert time_of(page) == pytest.approx(8.0)

    page.keyboard.press("Space")
    page.wait_for_function("() => player.clock.time < 4", timeout=5000)


def test_the_slider_the_strip_and_the_arrows_scrub(opened):
    page = opened()
    page.evaluate(
        """() => {
          const { scrub } = player.page;
          scrub.value = 3;
          scrub.dispatchEvent(new Event("input"));
        }"""
    )
    assert time_of(page) == pytest.approx(3.0)

    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowRight")
    assert time_of(page) == pytest.approx(4.1)

    frame = page.locator("#chart canvas").bounding_box()
    x = page.evaluate("player.chart.x(6)")
    page.mouse.click(frame["x"] + x, frame["y"] + 40)
    assert time_of(page) == pytest.approx(6.0, abs=0.02)
    settle(page)
    assert page.inner_text("#time") == "6.0 s"


def test_between_two_steps_an_agent_is_between_its_places(opened, view_model):
    page = opened(hash_="t=1.05")
    log = view_model.showings[0]
    row = log.ego

    pose = page.evaluate("(row) => player.panes[0].poses[row]", row)

    np.testing.assert_allclose(
        [pose["x"], pose["y"]], log.pose[row, 20:22, :2].mean(axis=0), atol=0.01
    )


def test_everyone_is_where_videos_and_strips_have_them(
    opened, view_model, tmp_path, crossing
):
    path = tmp_path / "crossing.html"
    short = make_view_model(crossing(), (with_newcomer(replay(crossing()), 40),))
    path.write_text(player_page(short))
    page = opened(path=path)
    times = [0.0, 9.5, 41.5, 42.0, 55.25, 60.5, 64.0, 68.0, 90.0]

    found = page.evaluate(
        """(times) => times.map((step) => {
          player.clock.jump((step - player.film.now) * player.film.stepS);
          player.frame(0);
          return player.panes.map((pane) => pane.poses);
        })""",
        times,
    )

    for time, panes in zip(times, found, strict=True):
        for showing, poses in zip(short.showings, panes, strict=True):
            moment = moment_at(showing, time)
            for row, pose in enumerate(poses):
                alpha = pose["alpha"] if pose else 0.0
                assert alpha == pytest.approx(float(moment.alpha[row]), abs=1e-3)
                if pose:
                    assert pose["ghost"] == moment.ghost[row]
                    read = [pose["x"], pose["y"], pose["heading"]]
                    np.testing.assert_allclose(read, moment.pose[row], atol=0.011)


def test_the_ego_is_in_the_middle_in_its_colour_and_others_in_theirs(opened):
    page = opened(hash_="t=5")
    picture = pixels(page, at=1)

    for role in ("ego", "initial", "inserted"):
        near = np.abs(picture[:, :3].astype(int) - colour(page, role)).max(axis=1) < 4
        assert near.sum() > 10, role
    place = page.evaluate(
        "({ pane, id }) => player.panes[pane].placeOf(id)",
        {
            "pane": 1,
            "id": page.evaluate("player.panes[1].showing.id[player.panes[1].showing.ego]"),
        },
    )
    size = page.evaluate("[player.panes[1].width, player.panes[1].height]")
    np.testing.assert_allclose([place["x"], place["y"]], np.array(size) / 2, atol=0.5)


def test_the_wheel_zooms_and_a_drag_moves_and_lets_go_of_the_ego(opened):
    page = opened()
    before = page.evaluate("player.panes[0].scale")
    frame = page.locator(".pane canvas").first.bounding_box()
    page.mouse.move(frame["x"] + 100, frame["y"] + 200)
    page.mouse.wheel(0, -300)
    page.wait_for_function("(before) => player.panes[0].scale > 1.3 * before", arg=before)

    scale = page.evaluate("player.panes[0].scale")
    centre = page.evaluate("player.panes[0].centre")
    page.mouse.down()
    page.mouse.move(frame["x"] + 140, frame["y"] + 180, steps=4)
    page.mouse.up()
    settle(page)
    moved = page.evaluate("player.panes[0].centre")
    assert moved["x"] == pytest.approx(centre["x"] - 40 / scale, abs=0.05)
    assert moved["y"] == pytest.approx(centre["y"] - 20 / scale, abs=0.05)
    assert page.get_attribute("#follow", "aria-pressed") == "false"
    assert page.evaluate("player.panes[1].centre") == moved

    page.keyboard.press("r")
    settle(page)
    assert page.evaluate("player.panes[0].scale") == pytest.approx(before)


def test_zooming_where_nobody_is_followed_keeps_the_place_under_the_pointer(opened):
    page = opened()
    place = page.evaluate(
        """() => {
          const [pane] = player.panes;
          const { camera } = player;
          camera.leave(pane);
          const world = () => {
            pane.look(camera, 10);
            return pane.centre.x + (30 - pane.width / 2) / pane.scale;
          };
          const before = world();
          camera.zoomBy(1.7, pane, { x: 30, y: 40 });
          return [before, world()];
        }"""
    )

    assert place[0] == pytest.approx(place[1], abs=1e-6)


def test_two_fingers_zoom(opened):
    page = opened(has_touch=True)
    before = page.evaluate("player.panes[0].scale")

    page.evaluate(
        """() => {
          const { canvas } = player.panes[0];
          canvas.setPointerCapture = () => {};
          const { left, top } = canvas.getBoundingClientRect();
          const send = (type, pointerId, x, y) => {
            const place = { clientX: left + x, clientY: top + y };
            canvas.dispatchEvent(new PointerEvent(type, { pointerId, ...place }));
          };
          send("pointerdown", 11, 100, 100);
          send("pointerdown", 12, 200, 100);
          send("pointermove", 12, 300, 100);
          send("pointerup", 11, 100, 100);
          send("pointerup", 12, 300, 100);
        }"""
    )
    settle(page)

    assert page.evaluate("player.panes[0].scale") == pytest.approx(2 * before)


def test_chips_and_keys_show_and_hide_and_one_always_stays(opened):
    page = opened()
    visible = lambda: page.locator(".pane:visible").count()  # noqa: E731
    assert visible() == 3

    page.get_by_role("button", name="rollout 1").click()
    assert visible() == 2
    page.keyboard.press("0")
    page.keyboard.press("l")
    assert visible() == 1
    page.keyboard.press("1")
    page.keyboard.press("0")
    assert visible() == 3

    page.locator(".alone").nth(1).click()
    assert page.locator(".pane:visible .name").text_content() == "rollout 0"
    page.locator(".alone").nth(1).click()
    assert visible() == 3


def test_pointing_at_an_agent_tells_what_is_known_of_it(opened, view_model):
    page = opened(hash_="t=5")
    newcomer = view_model.showings[1].id[-1].item()
    place = page.evaluate("(id) => player.panes[1].placeOf(id)", newcomer)
    frame = page.locator(".pane canvas").nth(1).bounding_box()

    page.mouse.move(frame["x"] + place["x"], frame["y"] + place["y"])
    page.wait_for_selector("#tooltip:visible")

    words = page.inner_text("#tooltip")
    assert words.lower().startswith(f"vehicle {newcomer}")
    for part in ("speed", "age", "2.9 s", "inserted at 2.1 s", "4.0 x 2.0 m"):
        assert part in words
    page.mouse.move(5, 5)
    page.wait_for_selector("#tooltip", state="hidden")


def test_a_click_keeps_an_agent_chosen_and_the_camera_follows_it(opened, view_model):
    page = opened(hash_="t=5")
    newcomer = view_model.showings[1].id[-1].item()
    place = page.evaluate("(id) => player.panes[1].placeOf(id)", newcomer)
    frame = page.locator(".pane canvas").nth(1).bounding_box()

    page.mouse.click(frame["x"] + place["x"], frame["y"] + place["y"])
    settle(page)

    middle = page.evaluate("(id) => player.panes[1].placeOf(id)", newcomer)
    assert middle["x"] == pytest.approx(frame["width"] / 2, abs=0.5)
    page.keyboard.press("Escape")
    settle(page)
    assert page.evaluate("player.options.pinned") is None


def test_who_leaves_fades_and_who_has_left_is_a_fading_outline(opened, tmp_path, crossing):
    path = tmp_path / "leaving.html"
    path.write_text(
        player_page(make_view_model(crossing(), ()))
    )  # Row 3 leaves at step 60.
    page = opened(path=path)

    alphas = page.evaluate(
        """() => [40, 55, 60, 63, 70].map((step) => {
          player.seek((step - 10) / 10);
          player.frame(0);
          return player.panes[0].poses[3];
        })"""
    )

    assert [pose and pose["ghost"] for pose in alphas] == [False, False, False, True, None]
    assert alphas[0]["alpha"] == 1
    assert 1 > alphas[1]["alpha"] > alphas[2]["alpha"] > alphas[3]["alpha"] > 0


def test_the_log_says_where_it_ends(opened, tmp_path, town, view_model):
    page = opened(hash_="t=8")
    assert page.locator(".over:visible").count() == 0

    page.evaluate("player.panes[0].showing.steps = 60; player.change()")
    settle(page)
    assert page.locator(".over:visible").inner_text() == "the log ends here"


def test_the_help_opens_and_closes_and_names_the_keys(opened):
    page = opened()
    page.keyboard.press("?")
    assert "play, pause" in page.inner_text("dialog[open]")
    page.keyboard.press("Escape")
    assert page.locator("dialog[open]").count() == 0


def test_dark_and_light_follow_the_system_until_switched(opened):
    light, dark = opened(color_scheme="light"), opened(color_scheme="dark")
    assert colour(light, "ground").sum() > 600 > 200 > colour(dark, "ground").sum()

    ground = colour(dark, "ground")
    dark.keyboard.press("x")
    settle(dark)
    assert (colour(dark, "ground") != ground).all()
    assert (pixels(dark)[:, :3] == colour(dark, "ground")).all(axis=1).mean() > 0.05


def test_nothing_is_cut_off_on_a_phone(opened):
    page = opened(viewport={"width": 390, "height": 844}, device_scale_factor=2)

    assert page.evaluate("document.documentElement.scrollWidth") == 390
    for name in ("#play", "#speed", "#follow", "#help", "#scrub", ".legend"):
        frame = page.locator(name).bounding_box()
        assert frame["x"] >= 0, name
        assert frame["x"] + frame["width"] <= 390, name
        assert frame["y"] + frame["height"] <= 844, name


def test_ids_are_written_as_they_are(opened, tmp_path, view_model):
    from dataclasses import replace  # noqa: PLC0415

    path = tmp_path / "evil.html"
    evil = "<img src=x onerror=throw(1)></script>"
    path.write_text(player_page(replace(view_model, scenario_id=evil)))

    page = opened(path=path)

    assert page.inner_text(".scene") == evil
    assert page.locator("img").count() == 0


def test_a_page_whose_film_is_damaged_says_so(browser, tmp_path, view_model):
    html = player_page(view_model)
    start = html.index('type="text/plain">') + 18
    path = tmp_path / "damaged.html"
    path.write_text(html[: start + 400] + "AAAA" + html[start + 404 :])
    page = browser.new_page()
    page.goto(path.as_uri())

    page.wait_for_function("() => document.querySelector('#failure').textContent")
    assert "This page cannot be shown" in page.inner_text("#failure")
    page.close()


def test_a_crowd_plays(opened, tmp_path, busy_film):
    path = tmp_path / "busy.html"
    path.write_text(player_page(busy_film))
    page = opened(path=path)

    page.evaluate("player.showAlone(1); player.play()")

    # How long a frame takes is told by benchmarks/player.py.
    page.wait_for_function("() => player.drawMs.length > 60", timeout=60_000)
