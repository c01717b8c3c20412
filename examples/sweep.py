"""
A sweep of training settings with Optuna
========================================

Each trial is a training run in a folder of its own, and is judged on episodes that neither the training nor
``rover-rl evaluate`` uses. Optuna keeps the trials in a file: the same program goes on where it was stopped. It needs
the extra ``sweep``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import optuna

from rover_rl.algos.config import training_config
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train import train

# %%
# What varies
# -----------
# A trial asks Optuna for its settings, trains with them, and drives the policy in the simulator that it learned in.

WORLD = "moon"
TRIALS = 8
STEPS = 500_000
EPISODES = 32
SECONDS = 60.0
FOLDER = Path("runs/sweep-moon")
episodes = draw_episodes(WORLD, EPISODES, seed=30_000)


def run(trial: optuna.Trial) -> float:
    """Trains with the settings of a trial, and returns the success rate of the policy."""
    settings = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "gamma": trial.suggest_categorical("gamma", [0.95, 0.97]),
    }
    name = f"trial-{trial.number}"
    config = training_config("ppo", world=WORLD, total_steps=STEPS, runs=str(FOLDER), name=name, **settings)
    try:
        actor = Checkpoint.load(train(config).checkpoint).make_actor()
    except FloatingPointError as error:
        raise optuna.TrialPruned(str(error)) from error  # The training diverged.
    env = replace(environment_for(actor, None), backend="warp")
    return evaluate(actor, episodes, name=name, env=env, seconds=SECONDS).success_rate


# %%
# The trials
# ----------

FOLDER.mkdir(parents=True, exist_ok=True)
sampler = optuna.samplers.TPESampler(seed=0)
storage = f"sqlite:///{FOLDER / 'sweep.db'}"
study = optuna.create_study(
    study_name="sweep", storage=storage, sampler=sampler, direction="maximize", load_if_exists=True
)
study.optimize(run, n_trials=TRIALS - len(study.trials))
print(f"best: trial {study.best_trial.number}, success {study.best_value:.0%}, {study.best_params}")

figure, axes = plt.subplots(layout="constrained")
axes.scatter([trial.params["learning_rate"] for trial in study.trials], [trial.value for trial in study.trials])
axes.set(xscale="log", xlabel="learning rate", ylabel="success rate")
plt.show()
