"""Active viewpoint planning in indoor scenes: simulators, the task, `AVP-v0`, baselines and rollouts.

Importing the package registers `AVP-v0` with gymnasium and costs milliseconds: simulators load on first use.
"""

import gymnasium

ENV_ID = "AVP-v0"

if ENV_ID not in gymnasium.registry:
    # The task counts its own budget, so gymnasium's TimeLimit is not used.
    gymnasium.register(ENV_ID, entry_point="avp_habitat.recording:make_env")
