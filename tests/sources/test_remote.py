from importlib.util import find_spec

import pytest

from infgen.errors import ConfigError
from infgen.sources.remote import file_system
from infgen.sources.tfrecord import frame, iter_records


def test_records_are_read_from_any_file_system():
    system, path = file_system("memory://remote/some.tfrecord")
    with system.open(path, "wb") as file:
        file.write(frame(b"one") + frame(b"two"))

    records = list(iter_records("memory://remote/some.tfrecord"))

    assert [record.data for record in records] == [b"one", b"two"]


def test_an_unknown_protocol_is_named():
    with pytest.raises(ConfigError, match=r"nowhere://a\.tfrecord cannot be read"):
        file_system("nowhere://a.tfrecord")


@pytest.mark.skipif(find_spec("obstore") is not None, reason="the cloud extra is installed")
@pytest.mark.skipif(find_spec("gcsfs") is not None, reason="gcsfs is installed")
def test_a_cloud_without_its_extra_says_what_to_install():
    with pytest.raises(ConfigError, match=r"infgen\[cloud\]"):
        file_system("gs://bucket/a.tfrecord")


@pytest.mark.skipif(find_spec("obstore") is None, reason="the cloud extra is not installed")
def test_clouds_go_through_obstore():
    system, path = file_system("gs://bucket/a.tfrecord")

    assert type(system).__module__.startswith("obstore")
    assert path.endswith("a.tfrecord")
