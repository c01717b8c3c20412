"""Rover environment: observations, actions, rewards, configuration, batched in PyTorch on any device.

The environment is independent of the simulator: see :mod:`rover_rl.sims`. "The contract" is the interface of the
original environment, RoboTerrain's ``RoverEnv``: its arguments, observation, action, events and reward.

``config`` describes an environment, and ``make`` builds it with a reward. ``rover`` is the loop: ``stages`` are what
commands and readings pass, ``simulation`` is the simulator with lidars and movers, ``rows`` are episodes, worlds and
robots, ``placement`` draws starts and goals, and ``task`` computes events. ``rewards`` and ``transforms`` are TorchRL
transforms, ``sensors`` are the entries of the observation, and ``gym``, ``sb3`` and ``wrappers`` are the interfaces of
other libraries.
"""
