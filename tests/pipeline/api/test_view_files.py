import hashlib

import numpy as np
import pytest

from infgen.errors import ConfigError, MissingExtraError
from infgen.views.scene.view_model import make_view_model
from infgen.views.video import painter
from infgen.views.video.layout import Format
from infgen.views.video.painter import rgb
from pipeline.api import view_files
from pipeline.api.view_files import write_strip, write_video
from pipeline.engine.signals import Stopped
from tests.exports.replays import replay

av = pytest.importorskip("av", reason="the extra video is not installed")
image = pytest.importorskip("PIL.Image", reason="the extra video is not installed")
FORM = Format(320, 240, 10)


def hashed(data):
    return hashlib.sha256(data).hexdigest()


def packets(path):
    with av.open(str(path)) as file:
        return [hashed(bytes(packet)) for packet in file.demux()]


@pytest.fixture(scope="module")
def view_model(scenes):
    return make_view_model(scenes[0], (replay(scenes[0]),))


def test_an_mp4_plays_every_frame_in_order(view_model, tmp_path):
    told = []
    path = write_video(
        view_model, tmp_path / "out" / "film.mp4", FORM, told.append, workers=0
    )

    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        frames = list(file.decode(stream))
        assert float(stream.average_rate) == 10
    assert (frames[0].width, frames[0].height) == (320, 240)
    assert [round(frame.time * 10) for frame in frames] == list(range(80))
    assert told[0]["event"] == "work-started"
    assert [event["done"] for event in told[1:]] == [50, 80]
    assert [each.name for each in path.parent.iterdir()] == ["film.mp4"]


def test_the_bytes_do_not_depend_on_the_number_of_processes(view_model, tmp_path):
    alone = write_video(view_model, tmp_path / "a.mp4", FORM, workers=0)
    by_two = write_video(view_model, tmp_path / "b.mp4", FORM, workers=2)

    # Which pictures differ, if any do; then all the rest of the file.
    assert packets(alone) == packets(by_two)
    assert hashed(alone.read_bytes()) == hashed(by_two.read_bytes())


def test_a_gif_repeats_and_lasts_as_long(view_model, tmp_path):
    path = write_video(view_model, tmp_path / "film.gif", FORM, workers=0)

    with image.open(path) as file:
        assert file.size == (320, 240)
        assert file.info["loop"] == 0
        durations = []
        for at in range(file.n_frames):
            file.seek(at)
            durations.append(file.info["duration"])
        shown = np.asarray(file.convert("RGB")).reshape(-1, 3)
    assert sum(durations) == 8000
    for name in ("ego", "initial"):
        assert (shown == rgb(getattr(FORM.colours, name))).all(axis=1).any()


def test_strips_are_written_as_drawings_and_as_pictures(view_model, tmp_path):
    drawing = write_strip(view_model, tmp_path / "s.svg", "light", 4.0)
    picture = write_strip(view_model, tmp_path / "s.png", "dark", 4.0)

    assert drawing.read_text().startswith("<svg")
    with image.open(picture) as file:
        assert file.size[0] > 3 * 2 * 260
        assert np.asarray(file).mean() < 128


@pytest.mark.parametrize("name", ["film.avi", "view_model", "film.mp4.txt"])
def test_another_ending_is_refused(view_model, tmp_path, name):
    with pytest.raises(ConfigError, match=r"expected a name that ends in \.mp4 or \.gif"):
        write_video(view_model, tmp_path / name, FORM)
    with pytest.raises(ConfigError, match=r"ends in \.svg or \.png"):
        write_strip(view_model, tmp_path / name, "light", 6.0)


def test_whoever_is_stopped_leaves_nothing(view_model, tmp_path, monkeypatch):
    def stop():
        raise Stopped(15)

    monkeypatch.setattr(view_files.signals, "raise_if_stopped", stop)

    with pytest.raises(Stopped):
        write_video(view_model, tmp_path / "film.mp4", FORM, workers=0)
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_told_before_any_work(view_model, tmp_path, monkeypatch):
    def refuse(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(painter, "import_module", refuse)

    with pytest.raises(MissingExtraError, match=r"pip install 'infgen\[video\]'"):
        write_video(view_model, tmp_path / "film.mp4", FORM, workers=0)
    assert write_strip(view_model, tmp_path / "s.svg", "light", 6.0).is_file()
