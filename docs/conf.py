"""Configuration of the documentation, which ``make docs`` builds with Sphinx. The build needs no network."""

from __future__ import annotations

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS / "_extensions"), str(DOCS.parent)]

from rover_rl import __version__  # noqa: E402, the checkout's package

project = "rover_rl"
author = "The rover_rl authors"
copyright = author
release = version = __version__
language = "en"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "command_help",
    "gallery",
    "docstrings",
    "replay",
]
exclude_patterns = ["_build", "gallery/**/*.ipynb", "gallery/**/*.py", "gallery/**/*.md5"]
# Listed by the navigation of the gallery alone.
suppress_warnings = ["toc.not_included"]

html_theme = "furo"
html_title = "rover_rl"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#a3461c", "color-brand-content": "#a3461c"},
    "dark_css_variables": {"color-brand-primary": "#f0a070", "color-brand-content": "#f0a070"},
    "footer_icons": [],
}
html_copy_source = False
html_show_sphinx = False
pygments_style = "tango"
pygments_dark_style = "monokai"
maximum_signature_line_length = 80

myst_enable_extensions = ["colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 5
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
autodoc_inherit_docstrings = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_preprocess_types = False
viewcode_line_numbers = True

nitpicky = True
toc_object_entries_show_parents = "hide"
# References to other projects stay without a link: their inventories are on the network.
nitpick_ignore_regex = [
    (r"py:.*", rf"(?:{'|'.join(roots)})(?:\..*)?")
    for roots in (
        (
            "torch",
            "tensordict",
            "torchrl",
            "gymnasium",
            "pettingzoo",
            "stable_baselines3",
            "numpy",
            "matplotlib",
            "scipy",
            "rich",
        ),
        ("collections", "pathlib", "typing", "enum", "dataclasses", "abc", "inspect"),
    )
]

# Names in annotations that autodoc cannot look up: imported for type checkers alone, or choices of strings.
nitpick_ignore = [
    ("py:class", name)
    for name in (
        *(
            "Area",
            "AutoresetMode",
            "Connection",
            "EnvBase",
            "Missing",
            "Path",
            "Reward",
            "RobotSettings",
            "RobotSource",
            "RunFiles",
            "Tensor",
            "rover_rl.algos.policy.baselines.Lane",
            "rover_rl.envs.stages.StepState",
            "rover_rl.algos.driving.Schedule",
            "rover_rl.algos.evaluation.trajectory.Encounters",
            "rover_rl.algos.evaluation.trajectory.MoverTrack",
            "rover_rl.algos.video.recording.Episode",
            "rover_rl.worlds.solids.Shape",
            "rover_rl.worlds.terrain.TerrainRows",
            "OtherRovers",
            "rover_rl.sims.free_space.fitting.Source",
            "'rover_rl.RoverEnv'",
            "TimeLimit",
            "TypeAliasForwardRef",
            "Transform",
            "Unknown",
            "Up",
        ),
        *(
            "Bounded",
            "CurriculumKind",
            "LearningOptions",
            "LidarPooling",
            "MemoryKind",
            "Unpack",
            "WrapperOptions",
            "View",
            "WorldSource",
        ),
        *("FrozenTrial", "Setting", "SpreadEnds", "rover_rl.algos.video.recording.Moment"),
        *(f"rover_rl.algos.experiments.{name}" for name in ("runs.Run", "comparison.Row", "comparison.Pair")),
    )
]
autodoc_type_aliases = {
    "RoverEnv": "rover_rl.RoverEnv",
    "Worlds": "rover_rl.worlds.world.Worlds",
    **{name: name for name in ("BackendLike", "RewardLike", "RobotLike", "RobotSettings", "WorldLike")},
}

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/(?!sweep)\w+\.py$",  # A sweep takes minutes.
    "within_subsection_order": "gallery.place_of",
    "thumbnail_size": (480, 360),
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "write_computation_times": False,
    "abort_on_example_error": True,
    "image_scrapers": ("matplotlib",),
    "matplotlib_animations": True,
}
