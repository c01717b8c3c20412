"""The command ``rover-rl benchmark``."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Union

import tyro

from rover_rl.algos.policy.names import resolve_policies
from rover_rl.cli.options import BACKEND, SEVERAL_POLICIES, EnvOptions, Force, Workers
from rover_rl.files import check_outputs

if TYPE_CHECKING:
    from rover_rl.algos.benchmarks.suite import Suite


@dataclass(frozen=True)
class _Benchmark:
    policies: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="POLICY ...", help=SEVERAL_POLICIES)
    ] = ()
    seed: int = 0
    """Seed of the starts of all runs but the first."""
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = field(default_factory=EnvOptions)
    backend: Annotated[str | None, tyro.conf.arg(help=BACKEND)] = None
    workers: Workers = None
    force: Force = False


@dataclass(frozen=True, kw_only=True)
class BarnBenchmark(_Benchmark):
    """Run policies in the worlds of BARN: 300 fields of cylinders, 10 m to the goal, 100 s, any contact fails."""

    data: Path
    """Folder of the public repository Daffan/the-barn-challenge, or of its worlds; or an .npz file of worlds."""
    worlds: str = "test"
    """Worlds: test (the 50 of the benchmark's score), train (the other 250), all, or numbers such as 1,7,20-29."""
    runs: int = 1
    """Number of runs in each world. All but the first start a few centimeters away from the benchmark's start."""
    out: Path = Path("runs/benchmark-barn")
    """Folder to write to."""

    def __call__(self) -> int:
        from rover_rl.algos.benchmarks.barn import Barn, read_barn

        courses = read_barn(self.data, self._numbers())
        return _run(Barn(courses, runs=self.runs, seed=self.seed), self)

    def _numbers(self) -> list[int] | None:
        from rover_rl.algos.benchmarks.barn import TEST_WORLDS, WORLDS

        sets = {"test": [*TEST_WORLDS], "train": [n for n in range(WORLDS) if n not in TEST_WORLDS], "all": None}
        return sets[self.worlds] if self.worlds in sets else _parsed(self.worlds, WORLDS, "test, train, all")


@dataclass(frozen=True, kw_only=True)
class JaxNavBenchmark(_Benchmark):
    """Run policies in levels of JaxNav: small mazes of cells of 1 m, any contact fails."""

    data: Path
    """File of levels: .npz with map_data, start_xy, start_theta, goal_xy and geodesic8."""
    runs: int = 4
    """Number of runs in each level. All but the first start a few centimeters away from the level's start. One half
    chooses the worst 10 % of the levels, and the other half scores them."""
    goal_radius: float = 0.3
    """Distance from the goal at which it is reached, m. JaxNav has 0.3; the policies of this package are trained with
    0.5."""
    seconds: float = 50.0
    """Time limit, s."""
    out: Path = Path("runs/benchmark-jaxnav")
    """Folder to write to."""

    def __call__(self) -> int:
        from rover_rl.algos.benchmarks.jaxnav import JaxNav, read_jaxnav

        courses, unsolvable = read_jaxnav(self.data)
        limits = {"goal_radius": self.goal_radius, "seconds": self.seconds}
        return _run(JaxNav(courses, unsolvable=unsolvable, runs=self.runs, seed=self.seed, **limits), self)


@dataclass(frozen=True)
class Benchmark:
    """Run policies in the worlds of others, as their benchmarks do."""

    benchmark: Annotated[
        Union[  # noqa: UP007
            Annotated[BarnBenchmark, tyro.conf.subcommand("barn", prefix_name=False)],
            Annotated[JaxNavBenchmark, tyro.conf.subcommand("jaxnav", prefix_name=False)],
        ],
        tyro.conf.arg(name=""),
    ]
    """Benchmark to run."""

    def __call__(self) -> int:
        return self.benchmark()


def _parsed(worlds: str, count: int, names: str) -> list[int]:
    """Returns the numbers of worlds below ``count`` that text such as 1,7,20-29 names, each once."""
    numbers: list[int] = []
    for part in worlds.split(","):
        ends = re.fullmatch(r"([0-9]{1,3})(?:-([0-9]{1,3}))?", part, re.ASCII)
        first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (1, 0)
        if not first <= last < count:
            raise ValueError(f"--worlds takes {names}, or numbers below {count}, such as 1,7,20-29, got {part!r}")
        numbers += range(first, last + 1)
    return [*dict.fromkeys(numbers)]


def _run(suite: Suite, options: BarnBenchmark | JaxNavBenchmark) -> int:
    from rover_rl.algos.benchmarks.suite import draw_worst_runs, print_results, run_suite, write_results

    out, environment = options.out, options.environment
    resolved = resolve_policies(options.policies, (suite.name,), environment.given_robot)
    policies = {one.name: (one.module, environment.description(one.module, options.backend)) for one in resolved}
    pictures = {name: out / f"worst-{re.sub('[:/]', '-', name)}.png" for name in policies}
    # Fails before the runs, which can take minutes.
    files = (out / "benchmark.json", out / "benchmark.csv", *pictures.values())
    check_outputs(*files, inputs=[options.data], force=options.force)
    out.mkdir(parents=True, exist_ok=True)
    results = run_suite(suite, policies, options.workers)
    try:
        write_results(out / "benchmark.json", results)
        for result in results:
            draw_worst_runs(result, pictures[result.name])
    finally:
        # Prints the results even if a file could not be written.
        print_results(results)
    print(f"Results: {out / 'benchmark.json'}, benchmark.csv")
    print("Worst runs: " + ", ".join(map(str, pictures.values())))
    return 0
