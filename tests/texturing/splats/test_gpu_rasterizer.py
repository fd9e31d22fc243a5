"""The rasterizer by gsplat's kernels gives what the rasterizer on the CPU gives: images, gradients, trained splats.

Where there is no GPU, slow functions of torch replace gsplat's kernels; they are compared with gsplat's own reference.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import look_at, pinhole
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F32, Camera
from scan2sim.texturing.splats import backends
from scan2sim.texturing.splats.backends import Scene, cpu, gpu
from scan2sim.texturing.splats.projection import Pinhole
from scan2sim.texturing.splats.training import Schedule, Training
from tests.fakes import gsplat_kernels
from tests.texturing.splats.test_rasterizer import splats
from tests.texturing.splats.test_training import BETWEEN, PATH, begun, photo, shots_of

CAMERA = Camera("pinhole", 52, 37, 40.0, 42.0, 25.3, 18.1)
POSE = look_at((0.3, -4.0, 1.2), (0, 0, 1))
PINHOLE = Pinhole.of(CAMERA, POSE)
Load = Callable[[F32], Scene]


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Threads of torch and numba, taking turns many times a second, would wait for each other on a busy machine."""
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def on_cpu(parameters: F32) -> Scene:
    """Splats rendered by the slow kernels."""
    from scan2sim.texturing.splats.gpu_rasterizer import GpuScene

    return GpuScene(parameters, "cpu", gsplat_kernels)


def gsplat_or_skip() -> backends.Backend:
    try:
        return backends.choose("gpu")
    except UnavailableError as error:
        pytest.skip(f"no GPU for splats: {error.cause}")


@pytest.fixture(params=["slow kernels", "gsplat"])
def load(request: pytest.FixtureRequest) -> Load:
    """Function that loads splats: with slow kernels, and with gsplat where it can run."""
    return on_cpu if request.param == "slow kernels" else gsplat_or_skip().scene


def known_depths(seed: int) -> F32:
    known = np.random.default_rng(seed).uniform(3, 7, (CAMERA.height, CAMERA.width)).astype(np.float32)
    known[::3] = 0
    return known


@pytest.mark.parametrize("seed", [1, 2])
def test_images_are_those_of_the_cpu(load: Load, seed: int) -> None:
    parameters, known = splats(150, seed), known_depths(seed)
    found, truth = (one(parameters).render(PINHOLE, known) for one in (load, cpu.scene))
    # the CPU blends nothing behind 0.3 % of transmittance, gsplat nothing behind 0.01 %
    assert np.abs(found.colour - truth.colour).max() < 0.006
    assert np.abs(found.transmittance - truth.transmittance).max() < 0.004
    assert np.abs(found.deviation - truth.deviation).max() < 0.003
    sure = np.abs(truth.transmittance - 0.5) > 0.005
    assert np.array_equal(np.isfinite(found.depth)[sure], np.isfinite(truth.depth)[sure])
    both = np.isfinite(found.depth) & np.isfinite(truth.depth)
    assert both.mean() > 0.3 and (np.abs(found.depth[both] - truth.depth[both]) < 0.01).mean() > 0.99
    behind = np.random.default_rng(seed).uniform(0, 1, (CAMERA.height, CAMERA.width, 3)).astype(np.float32)
    assert np.abs(found.over(behind) - truth.over(behind)).max() < 0.006
    assert set(truth.seen) <= set(found.seen)


@pytest.mark.parametrize("seed", [1, 2])
def test_gradients_are_those_of_the_cpu(load: Load, seed: int) -> None:
    random, parameters, known = np.random.default_rng(seed), splats(60, seed), known_depths(seed)
    shape = CAMERA.height, CAMERA.width
    behind = random.uniform(0, 1, (*shape, 3)).astype(np.float32)
    derivatives = [random.normal(size=size).astype(np.float32) for size in ((*shape, 3), shape, shape)]
    for used in ([0], [0, 1], [0, 2], [0, 1, 2]):  # by colour, deviation, alpha
        weights = [derivatives[k] if k in used else None for k in range(3)]
        assert weights[0] is not None
        found, truth = np.zeros((2, *parameters.shape))
        for total, one in ((found, load), (truth, cpu.scene)):
            drawn = one(parameters).render(PINHOLE, known)
            total[drawn.seen] = drawn.gradients(behind, weights[0], *weights[1:])
        for k in range(parameters.shape[1]):
            scale = np.abs(truth[:, k]).max()
            assert np.abs(found[:, k] - truth[:, k]).max() < 0.02 * scale, f"parameter {k} by {used}"


def test_pixels_of_unknown_depth_have_no_deviation(load: Load) -> None:
    drawn = load(splats(60)).render(PINHOLE, known_depths(1))
    assert drawn.deviation[1].any() and not drawn.deviation[::3].any()
    assert not load(splats(60)).render(PINHOLE).deviation.any()


def test_nothing_in_the_image_shows_the_background(load: Load) -> None:
    behind = np.eye(4)
    behind[:3, 3] = 0, 0, 8
    drawn = load(splats(20)).render(Pinhole.of(CAMERA, behind), known_depths(1))
    assert len(drawn.seen) == 0 and not drawn.colour.any() and (drawn.transmittance == 1).all()
    assert np.isinf(drawn.depth).all() and not drawn.deviation.any()
    assert drawn.gradients(drawn.colour, 1 + drawn.colour, 1 + drawn.deviation).shape == (0, 14)


def test_depth_of_a_flat_splat_is_that_of_its_plane(load: Load) -> None:
    floor = Splats.of(
        np.array([[0, 0, 0.0]]), np.array([[0.5, 0.5, 0.001]]), np.array([[1.0, 0, 0, 0]]), np.array([0.99]),
        np.ones((1, 3)),
    )  # fmt: skip
    found, truth = (one(floor.parameters).render(PINHOLE).depth for one in (load, cpu.scene))
    both = np.isfinite(found) & np.isfinite(truth)
    assert np.ptp(truth[both]) > 0.9 and np.abs(found[both] - truth[both]).max() < 0.01


def test_a_training_ends_with_splats_that_are_as_good(load: Load) -> None:
    """Within .2 dB on a photo that wasn't used."""
    camera = pinhole(80, 60, field=80)
    photos = [photo(pose, camera, name=str(i)) for i, pose in enumerate(PATH[1:4])]
    (shot,) = shots_of(photo(BETWEEN, camera))
    found = {}

    def psnr(training: Training) -> float:
        drawn, behind = training.rendered(shot.levels[-1])
        return float(-10 * np.log10(np.square(np.clip(drawn.over(behind), 0, 1) - shot.rgb / 255).mean()))

    for one in (load, cpu.scene):
        training, seen = begun(photos)
        training.backend = SimpleNamespace(RANK=0, unavailable=cpu.unavailable, description=str, scene=one)
        before = psnr(training)
        training.run(seen, Schedule(epochs=(3, 3, 3)), lambda share, text: None)
        found[one] = psnr(training)
        assert found[one] > before + 2
    assert found[load] == pytest.approx(found[cpu.scene], abs=0.2)


def test_slow_kernels_project_as_the_reference_of_gsplat() -> None:
    """The reference has neither tight bounds nor other kernels that run without a GPU."""
    import torch

    pytest.importorskip("gsplat", reason="needs gsplat")
    from gsplat.cuda import _torch_impl as theirs

    parameters = torch.from_numpy(splats(150))
    pose, intrinsics = torch.eye(4)[None], torch.tensor([[[40.0, 0, 25.8], [0, 42.0, 18.6], [0, 0, 1]]])
    pose[0, :3, :3], pose[0, :3, 3] = torch.from_numpy(PINHOLE.rotation), torch.from_numpy(PINHOLE.translation)
    xyz, scales, quaternions, size = parameters[:, :3], parameters[:, 3:6].exp(), parameters[:, 6:10], (52, 37)
    covariances, _ = theirs._quat_scale_to_covar_preci(quaternions, scales, compute_preci=False)
    expected = theirs._fully_fused_projection(xyz, covariances, pose, intrinsics, *size, near_plane=0.2)
    found = gsplat_kernels.fully_fused_projection(
        xyz, None, quaternions, scales, pose, intrinsics, *size, near_plane=0.2, opacities=torch.full((150,), 0.99)
    )
    shown = (found[0] > 0).all(dim=-1)
    assert shown.sum() > 100 and torch.equal(shown, (expected[0] > 0).all(dim=-1))
    for ours, other in zip(found[1:4], expected[1:4], strict=True):
        assert torch.allclose(ours[shown], other[shown], rtol=1e-4, atol=1e-4)
    tiles = expected[1], expected[0], expected[2], 16, 4, 3
    _, keys, order = theirs._isect_tiles(*tiles)
    _, our_keys, our_order = gsplat_kernels.isect_tiles(*tiles)
    assert torch.equal(our_order, order.int())
    assert torch.equal(
        gsplat_kernels.isect_offset_encode(our_keys, 1, 4, 3), theirs._isect_offset_encode(keys, 1, 4, 3)
    )


def test_auto_is_the_cpu_without_gsplat_which_is_not_imported() -> None:
    if plugins.missing(backends.__name__, "gpu") is None:
        pytest.skip("gsplat is installed")
    chosen = backends.choose("auto")
    assert chosen is cpu and "CPU" in chosen.description() and "gsplat" not in sys.modules
    assert backends.rejected("auto", chosen) is None


def test_an_installed_backend_that_cannot_run_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "NEEDS", ())
    monkeypatch.setattr(gpu, "unavailable", lambda: Unavailable("finds no GPU", "Buy one"))
    chosen = backends.choose("auto")
    assert chosen is cpu
    assert backends.rejected("auto", chosen) == "splats are trained on the CPU, as gpu finds no GPU: Buy one"
    assert backends.rejected("cpu", chosen) is None
    with pytest.raises(UnavailableError, match="finds no GPU"):
        backends.choose("gpu")
