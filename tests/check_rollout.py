"""A short walk through the built-in room, as a rollout for the tests of the pose checks."""

import gymnasium

FORWARD, LEFT, RIGHT, UP, DOWN = range(5)
# Turns, tilts and steps, so that no fault leaves these poses as they are.
WALK = (
    DOWN,
    FORWARD,
    LEFT,
    FORWARD,
    LEFT,
    FORWARD,
    DOWN,
    LEFT,
    LEFT,
    FORWARD,
    FORWARD,
    UP,
    RIGHT,
    FORWARD,
    RIGHT,
    LEFT,
)
SPIN = (LEFT,) * 8


def write_walk(folder, actions=WALK, *, heldout=4, width=160, height=120):
    """Write a rollout of the given actions to a folder."""
    options = {"width": width, "height": height, "heldout": heldout, "policy": "a list of actions"}
    make = {"scene": "builtin:0", "budget": len(actions), "record": folder, "record_options": options}
    env = gymnasium.make("avp_habitat:AVP-v0", **make)
    try:
        env.reset(seed=1)
        for action in actions:
            env.step(action)
    finally:
        env.close()
    return folder
