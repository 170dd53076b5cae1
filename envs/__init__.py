"""Register the Gymnasium ids of the environments: three problems of the paper and three of our own."""

import gymnasium as gym

# The entry points are strings, so that gym.make imports only the modules of one environment (and PyBullet if needed).
ENTRY_POINTS = {
    "Lava-v0": "sb3_tdpg.envs.lava:LavaEnv",
    "BallCatch-v0": "sb3_tdpg.envs.ball_catch:BallCatchEnv",
    "PandaGrasp-v0": "sb3_tdpg.envs.panda_grasp:PandaGraspEnv",
    "SqueezeInsert-v0": "sb3_tdpg.envs.squeeze_insert:SqueezeInsertEnv",
    "PandaSqueeze-v0": "sb3_tdpg.envs.panda_squeeze:PandaSqueezeEnv",
    "PegCorner-v0": "sb3_tdpg.envs.peg_corner:PegCornerEnv",
}

# A problem counts as solved if the mean return is at least this threshold, which sets the default cost limit of `tune`.
# At the threshold the robot ends within 5 cm of the ball on average, and the arm lifts 97 of 100 mugs.
REWARD_THRESHOLDS = {"BallCatch-v0": -5.0, "PandaGrasp-v0": -0.03}

for _env_id, _entry_point in ENTRY_POINTS.items():
    # max_episode_steps is not set, because the horizon is part of the problem: an episode ends with `terminated`.
    if _env_id not in gym.registry:
        gym.register(id=_env_id, entry_point=_entry_point, reward_threshold=REWARD_THRESHOLDS.get(_env_id))
