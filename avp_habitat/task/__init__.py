"""The task: settings, actions, rewards, observations, the batched task and `AVP-v0`."""
