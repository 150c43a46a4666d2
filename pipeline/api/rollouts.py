"""The rollouts of one scene, and what can be made of them."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, overload

from infgen.clock import CLOCK
from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.exports.rows import rows_of
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from infgen.settings import build
from pipeline.api.scoring import Reference, SceneScores, score_rollouts
from pipeline.api.showing import PlayerPage, show_page, show_strip, show_video
from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.storage.saved_rollouts import is_saved, read_saved, write_saved
from pipeline.storage.scene_rollouts import find_in_root

if TYPE_CHECKING:
    import polars as pl
    import xarray as xr


@dataclass(frozen=True, repr=False)
class SceneRollouts(Sequence[Rollout]):
    """Simulated futures of one scene; ``rollouts[0]`` is one of them.

    Attributes:
        scene: The log that they continue.
        rollouts: One ``Rollout`` each, in order of their index.
        settings: How they were simulated; None for those of another simulator.
    """

    scene: Scene
    rollouts: tuple[Rollout, ...]
    settings: RolloutSettings | None = None

    def __len__(self) -> int:
        return len(self.rollouts)

    def __iter__(self) -> Iterator[Rollout]:
        return iter(self.rollouts)

    @overload
    def __getitem__(self, at: int) -> Rollout: ...

    @overload
    def __getitem__(self, at: slice) -> "SceneRollouts": ...

    def __getitem__(self, at: int | slice) -> "Rollout | SceneRollouts":
        """Return one rollout, or some of them with their scene."""
        if isinstance(at, slice):
            return SceneRollouts(self.scene, self.rollouts[at], self.settings)
        return self.rollouts[at]

    def __repr__(self) -> str:
        steps = max((one.num_steps for one in self.rollouts), default=0)
        seconds = max(0, steps - 1 - self.scene.now) * CLOCK.step_s
        return (
            f"SceneRollouts(scene {self.scene.scenario_id}, {len(self)} rollouts of "
            f"{seconds:g} s)"
        )

    def to_polars(self) -> "pl.DataFrame":
        """Lay them out as a table: one row per rollout, agent and step where it is there.

        Columns: ``scenario_id``; ``rollout``; ``agent`` (track id); ``agent_type``
        (``AgentType``); ``step`` and ``time_s`` (0 is now); ``x_m``, ``y_m``, ``z_m``
        (world frame, float64); ``heading_rad``; ``velocity_x_mps``, ``velocity_y_mps``;
        ``length_m``, ``width_m``, ``height_m``; ``is_ego``; ``is_logged`` (False:
        inserted); ``is_history`` (not simulated). They are those of ``infgen export --to
        parquet``.
        """
        import polars as pl  # noqa: PLC0415  # Takes 0.2 s.

        columns = pl.DataFrame(dict(rows_of(self.rollouts, self.scene)))
        name = pl.lit(self.scene.scenario_id).alias("scenario_id")
        return columns.select(name, *columns.columns)

    def to_xarray(self) -> "xr.Dataset":
        """Lay them out as arrays ``[rollout, agent, step]``, world frame.

        Rows of agents are filled up to the largest rollout's; logged agents have the same
        row in all. Where ``valid`` is False, values are NaN.

        Raises:
            MissingExtraError: if xarray is not installed.
        """
        from pipeline.api.datasets import to_dataset  # noqa: PLC0415  # Only if wanted.

        return to_dataset(self.rollouts, self.scene)

    def save(self, path: str | Path) -> Path:
        """Write them and their scene to a new folder; return its path.

        ``infgen.open_rollouts`` reads it again. ``infgen view PATH``, ``infgen wosac PATH
        PATH`` and ``infgen export PATH --to FORMAT --out OUT`` read it too.

        Raises:
            ConfigError: if there is something already.
        """
        settings = asdict(self.settings) if self.settings is not None else {}
        write_saved(Path(path), self.scene, self.rollouts, settings)
        return Path(path)

    def score(
        self, metric: str = "wosac-2025", *, reference: Reference | None = None
    ) -> SceneScores:
        """Score them against the log of their scene: see ``infgen.score``."""
        return score_rollouts(self.rollouts, self.scene, metric, reference)

    def view(
        self, path: str | Path | None = None, *, most: int = 3, log: bool = True
    ) -> PlayerPage:
        """Write a page that plays them beside the log, in any browser.

        The page shows itself where it is the last value of a notebook's cell.

        Args:
            path: The page; ``SCENARIO_ID.html`` in the current folder if None.
            most: Rollouts that are shown, the first ones.
            log: Whether the log is shown too.
        """
        return show_page(self.scene, self.rollouts[:most], path, log=log)

    def strip(
        self, path: str | Path, *, every_s: float = 6.0, most: int = 1, log: bool = True
    ) -> Path:
        """Write moments side by side as an SVG, or as a PNG (extra ``video``).

        Args:
            path: The picture.
            every_s: Seconds from moment to moment.
            most: Rollouts that are shown, the first ones.
            log: Whether the log is shown too.

        Raises:
            ConfigError: if the name ends otherwise.
            MissingExtraError: if a PNG cannot be painted.
        """
        return show_strip(self.scene, self.rollouts[:most], Path(path), every_s, log=log)

    def video(
        self,
        path: str | Path,
        *,
        size_px: tuple[int, int] = (1920, 1080),
        most: int = 3,
        log: bool = True,
        workers: int = 0,
    ) -> Path:
        """Write a video, MP4 or GIF (extra ``video``).

        Args:
            path: The video.
            size_px: Width and height.
            most: Rollouts that are shown, the first ones.
            log: Whether the log is shown too.
            workers: Processes that paint; 0 for this one alone. A script that asks for more
                must begin with ``if __name__ == "__main__":``, as they import it.

        Raises:
            ConfigError: if the name ends otherwise, or for a size that cannot be encoded.
            MissingExtraError: if the packages that paint and encode are not installed.
        """
        shown = self.rollouts[:most]
        return show_video(self.scene, shown, Path(path), size_px, log=log, workers=workers)


def open_rollouts(path: str | Path, *, scene: str = "") -> SceneRollouts:
    """Read rollouts that were saved, or those of one scene of a root.

    Args:
        path: A folder that ``rollouts.save`` wrote, or the root of a run.
        scene: Start of the scene's id in a root; the first scene if empty.

    Raises:
        ConfigError: if there are no rollouts, or no such scene.
        StoreError: if they are damaged.
    """
    folder = Path(path)
    root = Root(folder.absolute())
    if root.store.is_dir():
        return _of_root(root, scene)
    if not is_saved(folder):
        raise ConfigError(
            f"{folder} holds no rollouts; expected a folder that rollouts.save() wrote, or "
            "the root of a run"
        )
    found = read_saved(folder)
    settings = build(RolloutSettings, found.settings, str(folder))
    return SceneRollouts(found.scene, found.rollouts, settings if found.settings else None)


def _of_root(root: Root, scene: str) -> SceneRollouts:
    folder = root.latest_folder("rollout")
    found = find_in_root(root, scene, None, most=None)
    if folder is None or not found.rollouts:
        raise ConfigError(
            f"{root.path} holds no rollouts of scene {found.scene.scenario_id}; "
            f"`infgen rollout --root {root.path}` makes some"
        )
    settings = read_manifest(folder)["settings"]["rollout"]
    return SceneRollouts(
        found.scene, found.rollouts, build(RolloutSettings, settings, str(folder))
    )
