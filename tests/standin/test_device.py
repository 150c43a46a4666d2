"""The stand-in device refuses what a GPU refuses, and counts what it would wait for."""


def test_it_refuses_mixed_devices_and_counts_kernels_and_waits(case):
    found = case("device")

    assert len(found["refused"]) == 1  # Single numbers are allowed.
    assert "(4,) on standin:0, (4,) on cpu" in found["refused"][0]
    kernels = {name: count[0] for name, count in found["counts"].items()}
    waits = {name: count[1] for name, count in found["counts"].items()}
    assert waits == {
        "to the device": 1,
        "from pinned memory": 0,
        "to the host": 1,
        "a number": 1,
        "places of a mask": 1,
        "a sum": 0,
    }
    assert kernels["a sum"] == 1
    assert found["gradient"] == [2.0, 2.0, 2.0, 2.0]


def test_it_casts_under_autocast_as_cuda_does_and_refuses_two_types(case):
    found = case("types")

    assert found["made"] == {
        "linear": "torch.bfloat16",
        "added": "torch.bfloat16",
        "softmax": "torch.float32",
        "norm": "torch.float32",
    }
    assert found["refused"] == {"lerp": "RuntimeError", "norm": "MixedTypesError"}
