"""One table names the baselines: the command line, its help, its errors and the docs agree with it."""

from __future__ import annotations

from pathlib import Path

import pytest

from rover_rl import EnvConfig, RoverEnv
from rover_rl.algos.policy.names import BASELINES, NO_POLICY, make_baseline, resolve_policy
from rover_rl.algos.policy.runner import PolicyRunner, sensors_for
from rover_rl.cli import main
from rover_rl.cli.options import LIVE_POLICY, ONE_POLICY, SEVERAL_POLICIES

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_is_found_by_its_name_and_drives(name: str) -> None:
    policy = resolve_policy(name, ("maze",), "rover_zero").module
    assert type(policy) is type(make_baseline(name))
    assert policy is not None
    config = EnvConfig(world="maze", num_envs=2, lidar=getattr(policy, "made_for", EnvConfig()).lidar, backend="warp")
    env = RoverEnv(sensors_for(policy, config))
    assert PolicyRunner(policy, env=env)(env.reset()).shape == (2, 2)


def test_help_errors_and_docs_name_baselines_and_unknown_ones_are_refused(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    told, docs = capsys.readouterr().out, (DOCS / "evaluation.md").read_text()
    for name in BASELINES:
        assert all(name in text for text in (ONE_POLICY, SEVERAL_POLICIES, LIVE_POLICY, NO_POLICY, told))
        assert f"`{name}`" in docs
    with pytest.raises(ValueError, match="unknown baseline 'dwb', perhaps 'dwa'; use one of"):
        make_baseline("dwb")
    with pytest.raises(ValueError, match="unknown robot 'tank'"):
        make_baseline("dwa", "tank")
    assert main(["export", "scripted"]) == 2
    assert "no checkpoint at scripted: 'scripted' is a policy without training" in capsys.readouterr().err
