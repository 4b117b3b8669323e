"""The theme of our pages: what must be read stands out, what must be told apart can be, whoever looks."""

import re

import numpy as np
import pytest
from PIL import ImageColor
from test_render import VISION, seen_as

from gacrl.report.theme import theme

LIGHT, DARK = (dict(re.findall(r"--(\w+): (#\w{6})", part)) for part in theme().split("@media"))


def contrast(one: str, other: str) -> float:
    """The ratio of WCAG 2.2: 4.5 for text, 3 for the parts of a picture."""
    rgb = np.array([ImageColor.getrgb(colour) for colour in (one, other)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    dark, light = sorted((linear @ [0.2126, 0.7152, 0.0722] + 0.05).tolist())
    return light / dark


@pytest.mark.parametrize("colours", [LIGHT, DARK], ids=["light", "dark"])
def test_what_must_be_read_stands_out(colours: dict[str, str]):
    assert set(LIGHT) == set(DARK)
    for ground in ("ground", "outside", "panel"):
        for text in ("ink", "faint", "alarm", "accent"):
            assert contrast(colours[text], colours[ground]) >= 4.5, (text, ground)
        assert contrast(colours["edge"], colours[ground]) >= 3, ground
    assert contrast(colours["ink"], colours["body"]) >= 4.5 and contrast(colours["rim"], colours["body"]) >= 3


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("colours", [LIGHT, DARK], ids=["light", "dark"])
def test_an_alarm_is_no_rim_and_no_edge(colours: dict[str, str], vision: str):
    """Who touches another, and what is done to words, beside what is as ever."""
    for usual in ("rim", "edge", "trail", "body"):
        assert np.linalg.norm(seen_as(colours["alarm"], vision) - seen_as(colours[usual], vision)) > 20, usual
