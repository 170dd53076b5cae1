"""The encoder of images: pixels are pooled to their means before the first layer."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import ToyEnv
from stable_baselines3 import PPO
from torch import nn
from torch.nn.functional import avg_pool2d

from sb3_tdpg.features import TRVCnn


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


def test_a_texture_finer_than_the_layers_step_is_seen_as_its_mean():
    """Stripes of one pixel that move by a pixel: without pooling, the features of a random layer move with them."""
    space = spaces.Box(0, 255, (3, 24, 24), np.uint8)
    stripes = np.zeros((2, 3, 24, 24), np.uint8)
    stripes[0, :, :, ::2] = stripes[1, :, :, 1::2] = 255
    th.manual_seed(0)
    moved = {
        pool: th.diff(TRVCnn(space, pool=pool)(th.as_tensor(stripes) / 255.0), dim=0).abs().max() for pool in (1, 2)
    }
    assert moved[2] < 1e-6 < 0.1 < moved[1]


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


def test_the_convolutions_can_stand_in_sb3s_own_policies():
    """SB3 initialises weights orthogonally, which needs them contiguous."""
    env = ToyEnv(spaces.Box(0, 255, (3, 20, 16), np.uint8))
    PPO("CnnPolicy", env, policy_kwargs=dict(features_extractor_class=TRVCnn), n_steps=8, batch_size=8).learn(8)
