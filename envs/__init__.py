"""The environments, the paper's and three of our own; importing this package registers their Gymnasium ids."""

import gymnasium as gym

# String entry points: an environment's module (and with it PyBullet) is imported only when it is made.
ENTRY_POINTS = {
    "Lava-v0": "sb3_tdpg.envs.lava:LavaEnv",
    "BallCatch-v0": "sb3_tdpg.envs.ball_catch:BallCatchEnv",
    "PandaGrasp-v0": "sb3_tdpg.envs.panda_grasp:PandaGraspEnv",
    "SqueezeInsert-v0": "sb3_tdpg.envs.squeeze_insert:SqueezeInsertEnv",
    "PandaSqueeze-v0": "sb3_tdpg.envs.panda_squeeze:PandaSqueezeEnv",
    "PegCorner-v0": "sb3_tdpg.envs.peg_corner:PegCornerEnv",
}

# Returns at which a problem counts as solved: the default limit of a sweep's selection. The ball is caught within 5 cm;
# of a hundred mugs 97 are lifted.
REWARD_THRESHOLDS = {"BallCatch-v0": -5.0, "PandaGrasp-v0": -0.03}

for _env_id, _entry_point in ENTRY_POINTS.items():
    # No max_episode_steps: the horizon belongs to the problem and ends as `terminated`, not as a time limit.
    if _env_id not in gym.registry:
        gym.register(id=_env_id, entry_point=_entry_point, reward_threshold=REWARD_THRESHOLDS.get(_env_id))
