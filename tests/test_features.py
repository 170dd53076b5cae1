"""Preprocessing before the encoder: the kind of an observation, the scale of depth images, the layers for images."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import ToyEnv
from stable_baselines3 import PPO
from torch import nn
from torch.nn.functional import avg_pool2d

from sb3_tdpg.features import SpatialSoftmax, TRVCnn, least_side, observation_kind
from sb3_tdpg.policies import TRVPolicy

DEPTH = spaces.Box(0.2, 0.7, (1, 24, 20), np.float32)


@pytest.mark.parametrize("shape", [(3, 24, 24), (1, 25, 26), (3, 26, 25)])
def test_pixels_are_pooled_to_their_means(shape):
    space = spaces.Box(0, 255, shape, np.uint8)
    cnn = TRVCnn(space, pool=2)
    images = th.randint(256, (5, *shape), dtype=th.uint8, generator=th.Generator().manual_seed(0))
    pooled = cnn.pooled(images)
    th.testing.assert_close(pooled, avg_pool2d(images.float(), 2))
    th.testing.assert_close(cnn.pooled(images.contiguous(memory_format=th.channels_last)), pooled)
    assert cnn.pooled(pooled) is pooled
    th.testing.assert_close(cnn(images / 255.0), cnn(pooled / 255.0))


def test_small_images_are_not_pooled():
    assert TRVCnn(spaces.Box(0, 255, (3, 16, 16), np.uint8), pool=2).pool == 1
    assert TRVCnn(spaces.Box(0, 255, (3, 20, 40), np.uint8), pool=2).pool == 2


def test_a_last_linear_layer_gives_the_number_of_features_that_was_asked_for():
    space = spaces.Box(0, 255, (3, 20, 40), np.uint8)
    cnn = TRVCnn(space, layers=((4, 4, 2), (8, 3, 1)), activation_fn=nn.ReLU, features_dim=7, pool=2)
    features = cnn(th.as_tensor(np.stack([space.sample() for _ in range(5)])) / 255.0)
    assert (cnn.features_dim, features.shape) == (7, (5, 7))
    assert (features >= 0).all()
    assert [m.out_channels for m in cnn.cnn if isinstance(m, nn.Conv2d)] == [4, 8]


def test_images_smaller_than_the_layers_are_refused():
    with pytest.raises(ValueError, match=r"\(9, 9\) pixels are too small for layers=.*10 a side"):
        TRVCnn(spaces.Box(0, 255, (3, 9, 9), np.uint8))


@pytest.mark.parametrize("axis", [2, 3])
def test_a_keypoint_moves_in_proportion_to_what_moves_in_the_image(axis):
    space = spaces.Box(0.0, 1.0, (1, 64, 48), np.float32)
    th.manual_seed(0)
    cnn = TRVCnn(space, layers=((8, 6, 2), (5, 4, 2)), keypoints=True)
    first = th.full((1, 1, 64, 48), 0.8)
    first[:, :, 18:30, 16:26] = 0.1
    images = th.cat([first.roll(shift, axis) for shift in (-4, 0, 4, 8)])  # the layers' total stride is 4 pixels
    x_and_y = cnn(images).view(4, 5, 2)
    moved = th.diff(x_and_y, dim=0)  # (3, channels, 2)
    along, across = moved[..., 3 - axis], moved[..., axis - 2]
    assert across.abs().max() < 1e-5 < 0.01 < along[0].abs().max()
    th.testing.assert_close(along[1:], along[:1].expand(2, -1), atol=1e-5, rtol=1e-4)
    assert cnn.features_dim == 10
    assert x_and_y.abs().max() <= 1


def test_keypoints_need_a_map_and_small_depth_images_have_the_papers_layers():
    layers = ((16, 6, 2), (16, 4, 2))
    assert least_side(layers, keypoints=True) == 20
    with pytest.raises(ValueError, match="20 a side"):
        TRVCnn(spaces.Box(0, 1, (1, 19, 30), np.float32), layers, keypoints=True)
    for side in (19, 20):
        space = spaces.Box(0, 1, (1, side, 30), np.float32)
        policy = TRVPolicy(space, spaces.Box(-1, 1, (1,)), lambda _: 1e-3, horizon=1)
        assert any(isinstance(module, SpatialSoftmax) for module in policy.modules()) == (side == 20)


def test_the_convolutions_can_stand_in_sb3s_own_policies():
    """SB3 initialises weights orthogonally, which needs contiguous weights."""
    env = ToyEnv(spaces.Box(0, 255, (3, 20, 16), np.uint8))
    PPO("CnnPolicy", env, policy_kwargs=dict(features_extractor_class=TRVCnn), n_steps=8, batch_size=8).learn(8)


@pytest.mark.parametrize(("low", "high", "expected"), [
    (0.2, 0.7, (-1.0, 0.0, 1.0)),
    (0.0, 2.0, (-1.0, 0.0, 1.0)),
    (-1.0, 1.0, (-1.0, 0.0, 1.0)),
    (0.5, 0.5, (0.5, 0.5, 0.5)),  # equal bounds: the values do not change
    (0.0, np.inf, (0.0, 1.0, 2.0)),
])  # fmt: skip
def test_images_of_floats_are_brought_from_their_bounds_to_plus_and_minus_one(low, high, expected):
    extractor = TRVCnn(spaces.Box(low, high, DEPTH.shape, np.float32))
    seen = []
    extractor.cnn.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    for share in (0.0, 0.5, 1.0):
        extractor(th.full((1, *DEPTH.shape), low + share * (min(high, low + 2.0) - low)))
    assert [float(image.mean()) for image in seen] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("space", "kind"), [
    (DEPTH, "depth"),
    (spaces.Box(0, 255, (3, 20, 16), np.uint8), "image"),
    (spaces.Box(0, 255, (20, 16, 3), np.uint8), "image"),
    (spaces.Box(-np.inf, np.inf, (3,), np.float32), "vector"),
    (spaces.Box(0, 1, (24, 20, 1), np.float32), "vector"),  # channels last
    (spaces.Box(0, 1, (1, 5, 5), np.float32), "vector"),  # too small for the convolutions
    (spaces.Box(0, 1, (3, 24, 20), np.float32), "vector"),
    (spaces.Discrete(3), "vector"),
    (None, "vector"),
], ids=str)  # fmt: skip
def test_the_kind_of_an_observation_is_that_of_its_space(space, kind):
    assert observation_kind(space) == kind
