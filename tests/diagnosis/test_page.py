"""The page of a report: whole, self-contained, and never the place where a file's name runs."""

import dataclasses
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest

from torchrl_bayessim.diagnosis.drawing import Step, curves, means, ticks, waterfall
from torchrl_bayessim.diagnosis.markup import element, table
from torchrl_bayessim.diagnosis.page import page, write_page
from torchrl_bayessim.diagnosis.report import Candidate, Finding, Gap, Parameter, Report

HOSTILE = "<script>document.title='taken'</script><img src=x onerror=alert(1)>\"'&"
VOID = {"meta", "br", "col"}
BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome", "chrome")
     if (path := shutil.which(name))), None,
)  # fmt: skip
PANELS = [
    "How large is the gap?",
    "Where is it?",
    "What speaks for each effect?",
    "The worst test segments",
    "What the missing force looks like",
    "Which effects look alike",
    "Parameters before and after",
    "What to record next",
    "How this was found",
]


def candidate(name="coulomb_friction", where="hinge", status="ruled_out", **changes):
    values = {
        "strength": 0.11,
        "ci95": None,
        "likelihood_ratio": 10.0,
        "p_value": 0.2,
        "held_out_gain": None,
        "explained_fraction": 0.1,
        "explained_by_parameters": 0.3,
        "minimal_detectable_strength": None,
    }
    return Candidate(name=name, where=where, status=status, **(values | changes))


def location(name):
    return {
        "channel": {"sensing": 0.0, "actuation": 0.2, "body": 0.8, "contact": 0.0},
        "outputs": [{"name": name, "share": 1.0}],
        "joints": [{"name": name, "share": 1.0}],
        "regimes": [{"rule": f"|{name} velocity| < 0.05", "support": 0.1, "share": 0.6}],
        "time": [{"t0": 0.0, "t1": 1.0, "share": 1.0}],
    }


def drawn(name):
    binned = {"x": [-1.0, 0.0, 1.0], "force": [0.1, 0.0, -0.1], "error": [0.01, 0.01, 0.01]}
    channel = {"name": name, "noise": 0.01, "real": [0.0, 0.1, 0.2]}
    channel |= {"without": [0.0, 0.3, None], "with": [0.0, 0.1, 0.2]}
    return {
        "waterfall": {"refit": [2.0, 4.0], "with_effects": [0.9, 1.4]},
        "segments": [{"log": name, "time": [0.0, 0.1, 0.2], "channels": [channel]}],
        "signature": {
            "joint": name,
            "unit": "N m",
            "curves": {"velocity": {"before": binned, "after": binned}},
        },
        "confusability": {
            "effects": [["coulomb_friction", name], ["payload", "all"]],
            "matrix": [[1.0, 0.4], [0.4, 1.0]],
        },
        "heat": {"outputs": [name], "feature": name, "cuts": [0.0], "excess": [[1.0, 3.0]]},
        "units": {f"coulomb_friction[{name}]": "N m"},
    }


def report(name="hinge"):
    """Return a report in which a name stands wherever one can stand."""
    found = Finding(
        name="coulomb_friction", where=name, strength=0.11, unit="N m", ci95=(0.10, 0.12),
        p_value=1e-20, share_of_gap=0.84, strengths={name: 0.11},
    )  # fmt: skip
    gap = Gap(
        horizon_steps=10, raw=5.1, refit=3.1, with_effects=1.3, floor=1.0,
        explained_fraction=0.86, ci95=(0.8, 0.9), by_parameters=0.5,
        rollout_rmse={"refit": {name: 0.12}, "with_effects": {name: 0.02}},
    )  # fmt: skip
    parameter = Parameter(
        name=name, prior=(0.3, 1.2), without_effects=1.19, with_effects=0.68, sd=0.01,
        at_bound=True,
    )  # fmt: skip
    step = {"excitation": name, "separates": [name, "payload"], "expected_odds": 30, "seconds": 20}
    return Report(
        verdict="named_partial",
        summary=f"Cause: coulomb friction at {name}.",
        effects=(found,),
        confusion_set=("coulomb_friction", name),
        where=location(name),
        remainder=location(name),
        gap=gap,
        candidates=(candidate(where=name, status="named", ci95=(0.1, 0.12)), candidate(name=name)),
        parameters=(parameter,),
        alarms=(f"warning: {name} rows 3 to 4: frozen",),
        next_experiment=(step,),
        audit={"train": [name], "seconds": 1.234, name: {"nested": name}},
        figures=drawn(name),
    )


class Outline(HTMLParser):
    """Checks that elements nest, and collects what a reader gets."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.text = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def bare(one):
    """Return a report as of a clean simulator without parameters, with nothing to draw."""
    return dataclasses.replace(
        one, verdict="none", effects=(), confusion_set=(), candidates=(), parameters=(),
        alarms=(), next_experiment=(), where={}, remainder={}, figures={},
    )  # fmt: skip


@pytest.mark.parametrize("make", [report, lambda: report(HOSTILE), lambda: bare(report())])
def test_it_is_well_formed_and_has_every_panel_in_order(make):
    outline = Outline(page(make()))
    text = "".join(outline.text)
    places = [text.index(title) for title in PANELS]
    assert places == sorted(places)
    assert text.count("Gap: ") == 1


def test_nothing_is_loaded_and_nothing_runs():
    text = page(report(HOSTILE))
    assert not re.search(r"https?:|//|@import|url\(", text)
    tags = Outline(text).tags
    assert {tag for tag, _ in tags}.isdisjoint({"script", "img", "link", "iframe", "object"})
    for _, attributes in tags:
        assert not any(name.startswith("on") or name in {"src", "href"} for name in attributes)
    policies = [a["content"] for _, a in tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; style-src 'unsafe-inline'"]


def test_hostile_names_are_shown_as_text():
    outline = Outline(page(report(HOSTILE)))
    assert sum(HOSTILE in text for text in outline.text) > 15


def test_pictures_have_words_and_tables_have_headers():
    tags = Outline(page(report())).tags
    names = [tag for tag, _ in tags]
    pictures = [attributes for tag, attributes in tags if tag == "svg"]
    assert len(pictures) == 4
    assert all(a["role"] == "img" and len(a["aria-label"]) > 10 for a in pictures)
    assert names.count("table") == names.count("caption") == names.count("thead")
    assert all(a["scope"] in {"row", "col"} for tag, a in tags if tag == "th")
    assert names.count("h1") == 1
    assert next(a for tag, a in tags if tag == "html")["lang"] == "en"


def test_what_was_found_comes_first_and_the_rest_is_folded():
    some = [candidate(name=f"effect{i}", likelihood_ratio=float(i)) for i in range(30)]
    found = candidate(status="named", likelihood_ratio=0.5)
    text = page(dataclasses.replace(report(), candidates=(*some, found)))
    evidence = text[text.index(PANELS[2]) : text.index(PANELS[3])]
    rows = re.findall(r'<tr><th scope="row">([^<]*)', evidence)
    assert rows == ["coulomb friction", *(f"effect{i}" for i in reversed(range(30)))]
    assert "<summary>19 more</summary>" in evidence


def test_the_waterfall_accounts_for_all_of_the_gap():
    (label,) = (a["aria-label"] for tag, a in Outline(page(report())).tags
                if tag == "svg" and "innovation" in a["aria-label"])  # fmt: skip
    assert label == (
        "Mean squared innovation. at the prior's mean: 5.1; credit to parameters: -2; "
        "parameters fitted: 3.1; credit to coulomb friction at hinge: -1.8; with effects: 1.3; "
        "perfect simulator: noise: 1"
    )


def test_a_simulation_that_runs_away_leaves_the_robot_visible():
    wild = curves(
        [0.0, 1.0, 2.0], {"real": [0.0, 1.0, 0.0], "without": [0.0, 1e6, None]}, title="q"
    )
    paths = re.findall(r'd="M([^"]*)" class="line real"', wild)
    heights = [float(point.split()[1]) for point in paths[0].split("L")]
    assert max(heights) - min(heights) > 100


def test_a_line_breaks_where_there_is_no_value():
    drawn = curves([0.0, 1.0, 2.0, 3.0], {"real": [0.0, None, 1.0, 2.0]}, title="q")
    assert drawn.count('class="line real"') == 2


def test_flat_and_single_values_can_be_drawn():
    one = {"x": [0.0], "force": [0.0], "error": [0.0]}
    for chart in (
        curves([0.0], {"real": [1.0]}, title="q"),
        curves([0.0, 1.0], {"real": [None, None]}, title="q"),
        means({"without": one}, title="force", x="velocity"),
        waterfall(
            [Step("nothing", 0.0, 0.0, "total"), Step("endless", 0.0, float("inf"), "total")]
        ),
    ):
        assert "nan" not in chart.replace("endless", "")
        Outline(chart)


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (0.0, 1e-6), (-3e5, 7e5), (0.97, 1.04)])
def test_ticks_are_few_round_and_inside(low, high):
    found = ticks(low, high)
    assert 3 <= len(found) <= 8
    assert low <= found[0] < found[-1] <= high
    assert all(len(f"{value:.3g}") <= 8 for value in found)


def test_elements_escape_what_is_not_markup():
    assert element("p", "<b>", element("b", "&")) == "<p>&lt;b&gt;<b>&amp;</b></p>"
    assert element("p", title='"><script>') == '<p title="&quot;&gt;&lt;script&gt;"></p>'
    assert element("p", None, class_="a", id=None) == '<p class="a"></p>'
    assert "<script>" not in table("<script>", ["<script>"], [["<script>"]])


@pytest.mark.skipif(BROWSER is None, reason="no headless browser is installed")
@pytest.mark.parametrize("make", [report, lambda: report(HOSTILE), lambda: bare(report())])
def test_a_browser_shows_it(make, tmp_path):
    write_page(make(), tmp_path / "report.html")
    command = [
        str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu",
        f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
        (tmp_path / "report.html").as_uri(),
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    assert f"<title>Gap: {make().verdict.replace('_', ' ')}</title>" in shown
    assert re.findall("<h2>(.*?)</h2>", shown) == PANELS
    assert shown.count("<svg") == len([t for t, _ in Outline(page(make())).tags if t == "svg"])
    assert "<script" not in shown
