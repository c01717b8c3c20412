"""Policies, training, evaluation, videos and deployment.

Modules:
    ``config``: settings of a training, in parts. ``config_files``: the same as plain data and YAML.
    ``policy``: networks, baselines, the privileged expert and checkpoints.
    ``train``: PPO, SAC, collectors, runs and their logs.
    ``evaluation``: episodes, metrics, tables and plots.
    ``video``: videos of policies.
    ``deploy``: exported policies, and drives of live rovers.
    ``pretrained``: the policies of the package, with a card each.
"""
