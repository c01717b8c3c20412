"""Draws the picture of the page about robots: the built-in ones, as ``docs/images/robots.jpg``.

python docs/draw_robots.py
"""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image, ImageDraw

from rover_rl.robots import ROBOTS, get_robot
from rover_rl.sims import make_simulator
from rover_rl.worlds import get_world

PATH = Path(__file__).parent / "images" / "robots.jpg"
SIZE = (480, 300)
CROP = (240, 200, 720, 500)
"""Part around the robot of a picture of twice the size."""
COLUMNS = 3
TURN = 2.2
"""Direction that the robots look in, rad."""


def main() -> None:
    """Draws the robots, each from behind, side by side."""
    rows = -(-len(ROBOTS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * SIZE[0], rows * SIZE[1]))
    for index, name in enumerate(ROBOTS):
        simulator = make_simulator("warp", worlds=[get_world("moon")], robot=get_robot(name))
        simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([[0.0, 0.0, TURN]]))
        picture = Image.fromarray(simulator.render(0, "chase", 2 * SIZE[0], 2 * SIZE[1]).numpy()).crop(CROP)
        simulator.close()
        ImageDraw.Draw(picture).text((10, 8), name, fill="white", font_size=18)
        sheet.paste(picture, (index % COLUMNS * SIZE[0], index // COLUMNS * SIZE[1]))
    sheet.save(PATH, quality=85)


if __name__ == "__main__":
    main()
