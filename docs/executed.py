"""Film docs/executed.gif, the first moves and the last ones of a replay that physics carried out:

pickplace-evaluate checkpoint=pretrained/mixed physics=execute hydra.run.dir=outputs/executed
python docs/executed.py outputs/executed/replay.html
"""

import io
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from selenium import webdriver

WIDTH, HEIGHT, RATE = 1280, 760, 12  # of the window, pixels; pictures a second
STEP = 0.045  # of a move between two pictures

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
    "document.getElementById('heat').checked = false; document.getElementById('seek').step = 'any'"
)
time.sleep(1)
pictures = []
for moment in [
    *np.arange(0, 3, STEP),
    *np.linspace(3, moves - 3, 60),
    *np.arange(moves - 3, moves, STEP),
    moves,
]:
    browser.execute_script(
        "const s = document.getElementById('seek'); s.value = arguments[0]; s.oninput()", float(moment)
    )
    time.sleep(0.05)
    image = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    pictures.append(
        image.resize((WIDTH // 2, image.height * WIDTH // 2 // image.width)).quantize(96, dither=Image.Dither.NONE)
    )
browser.quit()
times = [1000 // RATE] * (len(pictures) - 1) + [3000]
pictures[0].save(
    Path(__file__).with_name("executed.gif"), save_all=True, append_images=pictures[1:], duration=times, loop=0
)
