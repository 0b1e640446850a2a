"""Film docs/executed.gif, the first moves and the last ones of a replay that physics carried out:

pickplace-evaluate checkpoint=pretrained/mixed physics=execute hydra.run.dir=outputs/executed
python docs/executed.py outputs/executed/replay.html
"""

import io
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageChops
from selenium import webdriver

WIDTH, HEIGHT, RATE = 1280, 900, 12  # of the window, pixels; pictures a second
SIDE = 720  # width of the film, pixels
STEP = 0.06  # of a move between two pictures
HOLD = 8  # pictures before a move, in which the heat map can be read


def slowly(first, last):
    """Return the moments of some moves, each after a look at what the policy thinks of it."""
    return [moment for move in range(first, last) for moment in [move] * HOLD + [*np.arange(move, move + 1, STEP)]]


options = webdriver.ChromeOptions()
for word in ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"):
    options.add_argument(word)
options.add_argument(f"--window-size={WIDTH},{HEIGHT}")
browser = webdriver.Chrome(options=options)
browser.get(f"file://{Path(sys.argv[1]).absolute()}")
while not browser.execute_script("return !!window.replay"):
    time.sleep(0.1)
moves = browser.execute_script("return replay.state().moves")
browser.execute_script(
    "document.body.style.display = 'block'; document.getElementById('stage').style.height = '100vh';"
    "for (const id of ['panel', 'controls']) document.getElementById(id).style.display = 'none';"
    "document.getElementById('seek').step = 'any'"
)
time.sleep(1)
pictures = []
for moment in [
    *slowly(0, 3),
    *np.linspace(3, moves - 2, 50),
    *slowly(moves - 2, moves),
    moves,
]:
    browser.execute_script(
        "const s = document.getElementById('seek'); s.value = arguments[0]; s.oninput()", float(moment)
    )
    time.sleep(0.05)
    pictures.append(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"))
browser.quit()
# Crop all pictures to the area in which any of them shows something, and a margin.
boxes = np.array([ImageChops.difference(p, Image.new("RGB", p.size, p.getpixel((2, 2)))).getbbox() for p in pictures])
left, top, right, bottom = *(boxes[:, :2].min(0) - 20).clip(0), *(boxes[:, 2:].max(0) + 20).clip(0, pictures[0].size)
size = SIDE, round(SIDE * (bottom - top) / (right - left))
pictures = [p.crop((left, top, right, bottom)).resize(size).quantize(64, dither=Image.Dither.NONE) for p in pictures]
times = [1000 // RATE] * (len(pictures) - 1) + [3000]
pictures[0].save(
    Path(__file__).with_name("executed.gif"), save_all=True, append_images=pictures[1:], duration=times, loop=0
)
