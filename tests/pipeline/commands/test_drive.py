"""``infgen drive``: what it finds where nothing is named, and how it begins and ends."""

import re
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest

from infgen.errors import ConfigError
from pipeline.commands.drive import drive, open_garage
from tests.pipeline.drive.conftest import SCENE, wanted

CLI = Path(__file__).parents[3] / "cli.py"


def test_it_prints_its_address_and_ends_with_the_code_of_the_signal(tmp_path):
    # Of SIGTERM the tests in a browser know.
    words = [sys.executable, str(CLI), "drive", SCENE, "--no-browser"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        url = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32,}/", url)
        with urlopen(url) as page:
            assert b"drive.js" in page.read()

        process.send_signal(signal.SIGINT)

        assert process.wait(60) == 130
        assert process.stderr.read() == "infgen: stopped by SIGINT\n"


def test_a_port_that_is_taken_is_told(tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        words = wanted(tmp_path / "root", port=other.getsockname()[1], browser=False)
        with pytest.raises(OSError, match="Address already in use"):
            drive(words, print, print)


def test_without_a_root_the_package_has_all_that_is_needed(tmp_path):
    garage, number = open_garage(wanted(tmp_path / "root"))

    assert garage.scenes.ids[number] == SCENE
    assert garage.scenes.sources[SCENE] == "training.tfrecord-00000-of-00002.gz"
    settings = garage.simulator.settings
    assert (settings.count, settings.rules, settings.add_bias) == (1, "safe", 0)
    assert garage.folder.name == "drives"


def test_settings_are_those_of_the_words(tmp_path):
    words = wanted(
        tmp_path / "root", overrides=("rollout.max_agents=40",), out=tmp_path / "kept"
    )

    garage, _ = open_garage(words)

    assert garage.simulator.settings.max_agents == 40
    assert garage.folder == tmp_path / "kept"


def test_rules_are_those_of_the_words_if_they_name_some(tmp_path):
    def rules(*overrides):
        garage, _ = open_garage(wanted(tmp_path / "root", overrides=overrides))
        return garage.simulator.settings.rules_in_words

    assert rules("rollout.rules=none") == "none"
    assert rules("rollout.max_stall_s=30") == "safe, max_stall_s=30"


def test_a_scene_that_does_not_exist_is_told_with_some_that_do(tmp_path):
    with pytest.raises(ConfigError, match="no scene of those that may be driven"):
        open_garage(wanted(tmp_path / "root", scene="none"))


def test_weights_that_do_not_exist_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere/model\.json is missing"):
        open_garage(wanted(tmp_path / "root", weights=str(tmp_path / "nowhere")))


def test_a_root_with_scenes_is_driven_through(tmp_path, source):
    from tests.pipeline.storage.test_recordings import infgen  # noqa: PLC0415

    root = tmp_path / "root"
    assert infgen("ingest", source, "--root", root) == 0

    garage, number = open_garage(wanted(root, scene=""))

    assert number == 0
    assert set(garage.scenes.sources.values()) == {source.name}
    assert garage.scenes.find(0).scenario_id == garage.scenes.ids[0]
