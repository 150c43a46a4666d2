"""Toy stages that do small, real work on real files."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.events import Events
from pipeline.request import Request
from pipeline.root import Root
from pipeline.runner import Orders, Result, run

TOYS = Path(__file__).with_name("toys")
STAGES = """\
version: 1
stages:
  count: {module: toy_count, deps: [sources], params: [count]}
  total: {module: toy_total, deps: [count], params: [total]}
  climb: {module: toy_climb, deps: [total], params: [climb]}
params:
  total: {times: 2}
profiles:
  short: {count: {longest: 3}}
"""


@dataclass
class Workshop:
    """A root, a ``stages.yaml`` with three toy stages, and some texts to count."""

    folder: Path

    @property
    def root(self) -> Root:
        return Root(self.folder / "root")

    @property
    def file(self) -> Path:
        return self.folder / "stages.yaml"

    @property
    def texts(self) -> Path:
        return self.folder / "texts"

    def text(self, name: str, words: str) -> Path:
        path = self.texts / name
        path.write_text(words)
        return path

    def request(self, *overrides: str, profile: str | None = None) -> Request:
        records = (str(self.texts / "*.txt"),)
        return Request(self.root, self.file, profile, records, overrides)

    def plan(self, *overrides: str, targets: tuple[str, ...] = ()):
        return self.request(*overrides).plan(targets, {})

    def run(
        self,
        *overrides: str,
        targets: tuple[str, ...] = (),
        orders: Orders | None = None,
        events: list | None = None,
    ) -> dict[str, Result]:
        listeners = () if events is None else (events.append,)
        plan = self.plan(*overrides, targets=targets)
        self.request(*overrides).remember(plan)
        results = run(plan, orders or Orders(), Events(self.root, listeners))
        return {result.stage: result for result in results}

    def files(self) -> dict[str, bytes]:
        """Everything made, without what differs between runs."""
        return {
            str(path.relative_to(self.root.path)): path.read_bytes()
            for path in sorted(self.root.store.rglob("*"))
            if path.is_file()
            and path.name not in ("run.json", "lock", "begun-at", "attempt.json")
        }


@pytest.fixture
def workshop(tmp_path, monkeypatch) -> Workshop:
    monkeypatch.syspath_prepend(str(TOYS))
    # What syncing is for is not seen by a test, and it is most of a toy run's time.
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    shop = Workshop(tmp_path)
    shop.file.write_text(STAGES)
    shop.texts.mkdir()
    shop.text("a.txt", "one two three four")
    shop.text("b.txt", "lorem ipsum")
    yield shop
    for name in ("toy_count", "toy_total", "toy_climb"):
        sys.modules.pop(name, None)
