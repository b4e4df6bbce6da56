"""The image network: what it reads, what it doesn't, and what it refuses."""

from dataclasses import replace

import pytest
import torch

from envs import InputError, make_dynamics, make_task
from envs.camera import Camera
from envs.pixels import tracking_env
from policies import apg_pixels
from policies.pixel_network import PixelConfig, PixelNetwork, changes

CAMERA = Camera(height=24, width=48, scale=9.0)
TASK = make_task("cartpole", camera=CAMERA)


def network(seed=0, **shape):
    torch.manual_seed(seed)
    return PixelNetwork(PixelConfig(**PixelNetwork.contract(TASK), **shape))


def pixels(n=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (n, 12, 24, 48), generator=generator, dtype=torch.uint8)


def test_it_plans_the_horizon_in_range_for_any_batch():
    plan = network()(pixels(6).unflatten(0, (2, 3)))
    assert plan.shape == (2, 3, 10, 1)
    assert plan.abs().max() <= 1


def test_four_convolutions_of_kernel_three_as_in_the_paper():
    convolutions = network().encoder.convolutions
    assert [layer.kernel_size for layer in convolutions] == 4 * [(3, 3)]


def test_the_same_pictures_with_another_hidden_state_give_the_same_action():
    env = tracking_env(make_dynamics("cartpole"), TASK, TASK.episodes(4, "train", 0), (4,))
    actor = apg_pixels.actor(network(), TASK)
    now = env.rollout(5)[:, -1]
    other = now.clone()
    for key in ("state", "observation", "reference", "episode", "step"):
        other[key] = other[key] + 1
    with torch.no_grad():
        assert torch.equal(actor(now)["action"], actor(other)["action"])
        other["pixels"] = 255 - other["pixels"]
        assert not torch.equal(actor(now)["action"], actor(other)["action"])


def test_what_it_reads_is_the_newest_picture_and_the_difference_of_each_to_the_one_before():
    levels = pixels(2).float()
    read = changes(levels)
    assert torch.equal(read[:, :3], levels[:, :3])
    for k in range(3):
        assert torch.equal(
            read[:, 3 * k + 3 : 3 * k + 6], levels[:, 3 * k : 3 * k + 3] - levels[:, 3 * k + 3 : 3 * k + 6]
        )


def test_normalised_channels_have_zero_mean_and_unit_spread():
    net, seen = network(), pixels(50)
    net.encoder.normalise(seen)
    read = net.encoder.changes(seen.float()).transpose(0, 1).flatten(1)
    torch.testing.assert_close(read.mean(1), torch.zeros(12), atol=1e-3, rtol=0)
    torch.testing.assert_close(read.std(1), torch.ones(12), atol=1e-3, rtol=0)


def test_once_used_to_the_light_it_acts_in_half_of_it_as_it_did_in_all_of_it():
    net, seen = network(), (pixels(20) // 2) * 2
    net.encoder.normalise(seen)
    with torch.no_grad():
        bright = net(seen)
        dazed = net(seen // 2)
        net.encoder.expose(seen // 2)
        used = net(seen // 2)
    assert (used - bright).abs().max() < 0.05 * (dazed - bright).abs().max()


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        (lambda seen: seen.float(), r"\(12, 24, 48\) of float32"),
        (lambda seen: seen[:, :9], r"\(9, 24, 48\) of uint8"),
        (lambda seen: seen[..., :40], r"\(12, 24, 40\) of uint8"),
        (lambda seen: seen.movedim(1, -1), r"\(24, 48, 12\) of uint8"),
    ],
)
def test_pictures_of_another_shape_type_or_stack_are_refused_in_one_line(wrong, found):
    expected = r"expected \(12, 24, 48\) of uint8 \(channels, height, width\)$"
    with pytest.raises(InputError, match=f"^pixels: {found}, {expected}"):
        network()(wrong(pixels()))


def test_a_task_without_a_camera_has_no_pictures_to_offer():
    with pytest.raises(InputError, match=r"cartpole: the task has no camera"):
        PixelNetwork.contract(replace(TASK, camera=None))
