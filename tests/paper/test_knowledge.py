"""The information of a ball-catching policy."""

from sb3_tdpg import TDPG
from sb3_tdpg.paper import knowledge


def test_the_information_of_faint_trvs_is_less_and_nearly_none_behind_much_noise():
    nats = []
    for log_var in (-3.0, 0.0, 12.0):
        # Without a gate, which keeps the noise of the last TRVs.
        kwargs = dict(encoder_log_var_init=log_var, trv_dim=4, gate=False)
        model = TDPG("TRVPolicy", "BallCatch-v0", n_episodes=4, policy_kwargs=kwargs, seed=0, device="cpu")
        nats.append(knowledge.pooled_information(model, {}, n_episodes=20))
    assert nats[0] > nats[1] > nats[2] > 0
    assert nats[2] < 1
