"""Records that are not on this machine: fsspec, with obstore for the clouds."""

from importlib.util import find_spec
from typing import Any

from infgen.errors import ConfigError

CLOUDS = ("gs", "gcs", "s3", "s3a", "az", "abfs", "abfss")
"""Protocols that the ``cloud`` extra serves."""


class RemoteError(ConfigError):
    """A URL that nothing installed can read."""


def file_system(url: str) -> tuple[Any, str]:
    """Find the fsspec file system of a URL, and the path within it.

    Clouds are read through obstore (two packages) where it is installed, else through
    whatever fsspec finds for them.

    Raises:
        RemoteError: naming what to install.
    """
    import fsspec  # noqa: PLC0415

    scheme = url.split("://", 1)[0]
    if scheme in CLOUDS and find_spec("obstore"):
        from obstore.fsspec import register  # noqa: PLC0415

        register(scheme)
    try:
        system, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        hint = "pip install 'infgen[cloud]'" if scheme in CLOUDS else "use a known protocol"
        raise RemoteError(f"{url} cannot be read: {error}; {hint}") from error
    return system, path
