"""The web page in a real browser: its content, its updates, and that text is never read as markup."""

import logging
import re
import shutil
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest

from service.registry.registry import Registry
from service.store.models import OUTPUT_FILE, ActorStatus
from service.store.run_log import logging_to
from tests.status.browser import CHROMIUM, Visit, chromium
from tests.status.conftest import serve, write_home
from tests.status.runs import TOKEN, VIDEO, WRONG, append, grid, publish, record, write_runs, write_status, write_trial

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH; on Debian: apt-get install chromium")

NBSP = "\u00a0"
HOSTILE = "<img src=x onerror=alert(1)><script>alert(2)</script>"
LUMINANCE = """colour => {
  const channels = colour.match(/[0-9.]+/g).slice(0, 3).map(c => c / 255)
  const linear = channels.map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
  return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
}"""


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """One service and one page of it for all tests: the page's libraries take a browser seconds."""
    home = tmp_path_factory.mktemp("page")
    write_home(home)
    with chromium() as browser:
        shared = SimpleNamespace(browser=browser, home=home, server=serve(home))
        shared.server.start()
        shared.visit = Visit(browser, shared.server.url)
        yield shared
        shared.server.stop()


@pytest.fixture
def visit(shared):
    """The page, at no view; what its service has is new for each test."""
    write_home(shared.home)
    shared.visit.complaints.clear()
    shared.visit.asked.clear()
    yield shared.visit
    shared.visit.go("#/no/view").page.get_by_text("There is no page at this address.").wait_for()


@pytest.fixture
def home(shared, visit):
    return shared.home


def complaints(visit):
    """What the browser complained of, but for answers that are errors."""
    return [said for said in visit.complaints if "Failed to load resource" not in said]


# --- what it shows --------------------------------------------------------------------------------------------------


def test_nothing_goes_wrong_and_nothing_leaves_the_service(visit):
    for place, table in (("#/", "Runs"), ("#/runs/cube", "Actors"), ("#/primitives", "Versions of tiny")):
        visit.go(place).page.get_by_role("table", name=table, exact=True).wait_for()
        if place == "#/runs/cube":
            visit.points("alice/valid_fraction", 3)
            visit.page.get_by_text("2 goals of the sample in 2 cells").wait_for()
            visit.wait("document.querySelector('.space').dataset.cells === '2'")
    assert visit.complaints == []
    assert len(visit.asked) > 10
    assert [url for url in visit.asked if not url.startswith((f"{visit.url}/", "about:blank"))] == []


def test_runs(visit):
    page = visit.go().page
    page.get_by_text("1 active run, 2 runs in all.").wait_for()
    first, second = page.locator("tbody tr").all()
    assert first.locator("td").all_inner_texts()[:2] == ["cube\npanda-cube, ray", "running"]
    assert first.get_by_role("progressbar").get_attribute("value") == "0.3"
    assert f"3,000 of 10{NBSP}k" in first.inner_text()
    assert "500" in first.locator("td").nth(3).inner_text()
    first.get_by_text(f"37.5{NBSP}%").wait_for()  # Bob's success, the newest
    assert len(first.locator("polyline").get_attribute("points").split()) == 3
    assert second.locator(".chip").inner_text() == "finished"


def test_a_run(visit):
    page = visit.go("#/runs/cube").page
    page.get_by_role("heading", name="cube running").wait_for()
    assert page.title() == "cube \u00b7 Tandem"
    assert page.get_by_role("navigation", name="Breadcrumb").inner_text() == "Runs / cube"
    tiles = dict(text.split("\n", 1) for text in page.locator(".tile").all_inner_texts())
    assert tiles["Progress"].startswith(f"30.0{NBSP}%")
    assert f"about 14{NBSP}s to go" in tiles["Progress"]  # 7,000 env steps at 500 a second
    assert "6\n1 refused" in re.sub("\n+", "\n", tiles["Rollouts"])
    rows = page.get_by_role("table", name="Actors").locator("tbody tr")
    texts = [row.locator("td").all_inner_texts() for row in rows.all()]
    assert [text[0] for text in texts] == ["rollout-1", "learner", "rollout-0"]  # the starting one first
    assert texts[2][1:4] == ["alive", "2", "this machine"]
    assert re.fullmatch(rf"\d+{NBSP}(s|min) ago", texts[2][4])
    assert texts[2][7] == "killed"


def test_downstream_trainings(visit, home):
    for seed, success in enumerate((0.80, 0.82, 0.84)):
        write_trial(home / "runs", f"push-ours-{seed}", "push", "ours", seed, success)
    (write_trial(home / "runs", "wall", "wall", "scratch-mcp", 0, 0.5) / "episodes.mp4").write_bytes(VIDEO)
    publish(Registry(home / "registry"), "push-orchestrator", kind="orchestrator", task="push", primitives="tiny@1")
    page = visit.go("#/tasks").page
    page.get_by_role("table", name="Tasks").wait_for()
    ours, scratch = (text.split() for text in page.locator("tbody tr").all_inner_texts())
    assert ours == f"ours tiny@1 3 runs 82.0{NBSP}% 77 to 87, 3 seeds \u2013".split()
    assert scratch == f"scratch MCP no primitives wall \u2013 50.0{NBSP}% 44 to 56, 1 seed".split()
    page.get_by_role("link", name=f"82.0{NBSP}%").click()
    page.get_by_role("heading", name="3 runs compared").wait_for()
    assert visit.points("evaluation/success_last", 2, "push-ours-2")[-1] == (2000, 0.84)
    page.get_by_label("seeds as a band").check()
    band = "push, ours, with tiny@1 highest"
    visit.wait(f"document.querySelectorAll('.canvas')[0].data.some(({{name}}) => name === '{band}')")
    visit.go("#/runs/wall").page.get_by_text(f"tandem evaluate {home}/runs/wall").wait_for()
    assert f"50.0{NBSP}%" in page.locator(".tile").nth(1).inner_text()
    assert f"last step, 44 to 56{NBSP}%" in page.locator(".tile").nth(1).inner_text()
    parts = ["Curves", "Recordings", "Log", "Commands", "Configuration"]  # no goals, no actors
    assert page.locator("h2").all_inner_texts() == parts
    versions = visit.go("#/primitives").page.get_by_role("table", name="Versions of push-orchestrator")
    assert versions.locator("tbody td").nth(2).inner_text() == "push"
    visit.go("#/").page.get_by_label("Show").select_option("downstream")
    visit.wait("document.querySelectorAll('tbody tr').length === 4")
    assert complaints(visit) == []


def test_the_goal_map(visit):
    page = visit.go("#/runs/cube").page
    page.get_by_text("2 of 343 cells seen").wait_for()
    assert page.locator(".layer").count() == 7
    tried, untried = page.locator("rect.cell").all()
    assert tried.get_attribute("fill") == "rgb(94, 201, 98)"  # 0.75 on the scale
    assert untried.get_attribute("fill") is None
    # columns of 0.05 m from -0.2 m: 0.0 is in the fifth, and in the fifth row from below of seven
    assert [float(tried.get_attribute(axis)) for axis in "xy"] == pytest.approx([4.04, 2.04])
    assert page.locator(".layer").nth(2).locator("rect.cell").count() == 1  # 0.12 m is in the third layer
    tried.hover()
    reading = page.locator(".reading")
    assert reading.inner_text() == f"x 0, y 0, z 0.02 m: Bob solves 75.0{NBSP}%, learnability 0.188, 9 tries"
    untried.hover()
    assert reading.inner_text().endswith("m: no goal tried here yet")
    page.get_by_label("Learnability").check()
    assert page.locator("rect.cell").first.get_attribute("fill") == "rgb(94, 201, 98)"  # 0.1875 of 0.25
    page.get_by_label("Tries").check()
    assert page.locator("rect.cell").first.get_attribute("fill") == "rgb(253, 231, 37)"  # it has the most


def test_the_keyboard_reads_the_goal_map(visit, home):
    places = ((-0.15, 0.02), (0.0, 0.02), (0.0, 0.27))
    cells = tuple(grid().cells[0].model_copy(update={"center_m": (x, 0.0, z)}) for x, z in places)
    (home / "runs" / "cube" / "goals.json").write_text(grid().model_copy(update={"cells": cells}).model_dump_json())
    page = visit.go("#/runs/cube").page
    page.locator("rect.cell").first.wait_for()
    reading, goal_map = page.locator(".reading"), page.get_by_role("application")
    for key, place in (("ArrowUp", "x -0.15"), ("ArrowRight", "x 0,"), ("ArrowRight", "x 0,"), ("PageUp", "z 0.27")):
        goal_map.press(key)
        assert place in reading.inner_text()
    assert page.locator("rect.cell.chosen").count() == 1


def test_log_commands_and_configuration(visit, home):
    run = home / "runs" / "cube"
    (run / "config.yaml").write_text("name: panda-cube\nlearner: {bob: {target_kl: 0.03}}\n")
    with logging_to(run):
        logging.getLogger("service.cluster").warning("rollout actor 3 is gone (killed); another takes its place")
    page = visit.go("#/runs/cube").page
    page.locator(".log .warning").get_by_text("rollout actor 3 is gone (killed)").wait_for()
    assert page.get_by_text("What its processes wrote last").is_hidden()
    (run / OUTPUT_FILE).write_text("first\n")
    page.get_by_text("What its processes wrote last").click()
    page.get_by_text("first", exact=True).wait_for()
    (run / OUTPUT_FILE).write_text("first\nsecond\n")
    page.locator("details[open] pre").get_by_text("second").wait_for()  # it stays open
    page.locator(".command").get_by_text(f"touch {run}/stop", exact=True).wait_for()
    assert page.get_by_text("/v1/runs/cube/stop").count() == 1
    page.get_by_label("Find a setting").fill("target_kl")
    assert page.locator(".settings dt").all_inner_texts() == ["learner.bob.target_kl"]
    write_status(home / "runs", "cube", state="interrupted")
    page.locator(".command").get_by_text(f"tandem train --resume --run-dir {run} --registry").wait_for()


def test_versions(visit, home):
    for name in ("panda-1", "panda-2"):
        publish(Registry(home / "registry"), name)
    page = visit.go("#/primitives").page
    rows = page.get_by_role("table", name="Versions of tiny").locator("tbody tr")
    rows.first.wait_for()
    texts = [row.locator("td").all_inner_texts()[:3] for row in rows.all()]
    assert texts == [["tiny@2", "latest", f"50.0{NBSP}%"], ["tiny@1", "champion", f"50.0{NBSP}%"]]
    assert page.get_by_role("region", name="panda-2").count() == 1  # each has a heading of its own
    with page.expect_download() as download:
        rows.first.get_by_role("link", name="parameters of tiny@2").click()
    assert download.value.suggested_filename == "tiny-2.safetensors"
    assert visit.complaints == []


def test_the_newest_video_plays_and_older_ones(visit, home):
    run = home / "runs" / "old"
    (run / "recordings").mkdir()
    (run / "recordings" / "rounds-20260101T120000.mp4").write_bytes(VIDEO)
    path = str(run / "rounds.mp4")
    writer = imageio_ffmpeg.write_frames(path, (64, 32), fps=25, codec="libx264", macro_block_size=2)
    writer.send(None)
    for shade in range(0, 250, 10):
        writer.send(np.full((32, 64, 3), shade, np.uint8))
    writer.close()
    page = visit.go("#/runs/old").page
    visit.wait("document.querySelector('video')?.readyState >= 1")
    found = page.locator("video").evaluate("v => [v.videoWidth, v.videoHeight, v.duration]")
    assert found == [64, 32, pytest.approx(1.0, abs=0.1)]
    assert page.get_by_role("link", name="Curves").count() == 1
    page.get_by_role("list", name="Recordings").get_by_role("button").last.click()
    assert "rounds-20260101T120000.mp4" in page.locator("video").get_attribute("src")
    assert page.get_by_text("has no goal grid yet").count() == 1


# --- how it goes on -------------------------------------------------------------------------------------------------


def test_a_run_is_updated_live(visit, home):
    page = visit.go("#/runs/cube").page
    visit.points("alice/valid_fraction", 3)
    append(home / "runs", "cube", record(4, **{"alice/valid_fraction": 0.875}))
    assert visit.points("alice/valid_fraction", 4)[3] == (4000, 0.875)
    write_status(home / "runs", "cube", state="failed", last_error="it broke", warnings=("no Redis",), iteration=4)
    page.get_by_text("it broke").wait_for()
    assert page.locator(".warning").inner_text() == "Warning: no Redis"
    assert page.locator("h1 .chip").inner_text() == "failed"
    assert visit.complaints == []


def test_a_run_that_was_resumed_from_an_earlier_iteration(visit, home):
    visit.go("#/runs/cube")
    visit.points("bob/success_rate", 3)
    metrics = home / "runs" / "cube" / "metrics.jsonl"
    replaced = metrics.with_suffix(".new")
    replaced.write_bytes(metrics.read_bytes().splitlines(keepends=True)[0])
    replaced.replace(metrics)
    visit.points("bob/success_rate", 1)
    append(home / "runs", "cube", record(2, **{"bob/success_rate": 0.75}))
    assert visit.points("bob/success_rate", 2)[1] == (2000, 0.75)


def test_the_list_of_runs_is_updated_live(visit, home):
    page = visit.go().page
    page.get_by_role("link", name="cube", exact=True).focus()
    write_status(home / "runs", "cube", num_env_steps=5000, condition="disk", warnings=("cannot write",))
    write_status(home / "runs", "another")
    page.get_by_text("2 active runs, 3 runs in all.").wait_for()
    page.get_by_text(f"5,000 of 10{NBSP}k").wait_for()
    assert page.locator("tbody .chip.warn").all_inner_texts() == ["disk"]
    assert page.evaluate("document.activeElement.textContent") == "cube"  # a keyboard does not lose its place
    page.get_by_label("Choose cube").press("Space")
    page.get_by_role("button", name="Choose all shown").press("Space")
    page.get_by_role("link", name="Compare 3 runs").wait_for()
    assert page.locator("tbody input:checked").count() == 3
    page.get_by_label("Choose another").press("Space")
    write_status(home / "runs", "another", num_env_steps=6000)
    page.get_by_text(f"6,000 of 10{NBSP}k").wait_for()
    assert page.evaluate("document.activeElement.ariaLabel") == "Choose another"


def restart(shared):
    shared.server = serve(shared.home, port=shared.server.port)
    shared.server.start()


def test_the_service_goes_away_and_comes_back(visit, home, shared):
    page = visit.go("#/runs/cube").page
    visit.points("alice/valid_fraction", 3)
    banner = page.locator("#banner")
    assert banner.is_hidden()
    shared.server.stop()
    page.get_by_text("No answer from the service since").wait_for()
    append(home / "runs", "cube", record(4))
    assert page.locator("figure.chart .canvas svg.main-svg").count() >= 6  # what was known stays to be seen
    restart(shared)
    visit.points("alice/valid_fraction", 4)
    banner.wait_for(state="hidden")


def test_a_view_that_did_not_load_comes_when_the_service_is_back(shared):
    visit = Visit(shared.browser, shared.server.url)
    page = visit.go().page
    page.get_by_role("table").first.wait_for()
    shared.server.stop()
    visit.go("#/tasks")
    page.get_by_text("This view could not be loaded.").wait_for()
    restart(shared)
    page.get_by_role("heading", name="Tasks").wait_for()
    visit.context.close()


@pytest.mark.parametrize("place", ["#/", "#/runs/cube"])
def test_the_runs_go_away_and_come_back(visit, home, place):
    page = visit.go(place).page
    page.get_by_role("table").first.wait_for()
    (home / "runs").rename(home / "elsewhere")
    page.locator("#banner").get_by_text(str(home / "runs")).wait_for()
    visit.go("#/no/view").page.locator("#banner").wait_for(state="hidden")  # which asks for no runs
    visit.go(place).page.locator("#banner").get_by_text(str(home / "runs")).wait_for()
    (home / "elsewhere").rename(home / "runs")
    write_status(home / "runs", "cube", iteration=4)
    page.locator("#banner").wait_for(state="hidden")


def test_a_run_is_deleted_while_it_is_looked_at(visit, home):
    page = visit.go("#/runs/cube").page
    visit.points("alice/valid_fraction", 3)
    shutil.rmtree(home / "runs" / "cube")
    page.get_by_text("This run cannot be followed: No run 'cube' in").wait_for()
    assert page.locator("figure.chart .canvas svg.main-svg").count() >= 6  # what was known stays to be seen
    visit.go("#/compare/cube,old").page.get_by_text("no run 'cube' in").wait_for()
    assert len(visit.points("bob/success_rate", 3, "old")) == 3  # the others are shown all the same


# --- where one is ---------------------------------------------------------------------------------------------------


def test_links_are_permanent_and_the_keyboard_skips_to_the_content(visit):
    page = visit.go().page
    page.get_by_role("link", name="old", exact=True).click()
    page.get_by_role("heading", name="old finished").wait_for()
    assert page.url == f"{visit.url}/#/runs/old"
    page.reload()
    page.get_by_role("heading", name="old finished").wait_for()
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    assert page.url.endswith("#/runs/old")
    page.go_back()
    page.get_by_role("heading", name="Runs").wait_for()


def test_views_and_runs_that_do_not_exist(visit):
    for place, sentence in {
        "#/runs/nope": "No run 'nope' in",
        "#/runs/a/b": "There is no page at this address.",
        "#/runs/-bad-": "Path.run_id",
        "#/%": "There is no page at this address.",
        f"#/runs/{HOSTILE.replace('/', '%2F')}": "/openapi.json lists every route",
        f"#/runs/{HOSTILE}": "There is no page at this address.",
    }.items():
        page = visit.go(place).page
        page.locator("main").get_by_text(sentence).wait_for()
        assert page.get_by_role("link", name="All runs").count() == 1
        assert page.locator("main img, main script").count() == 0
    assert complaints(visit) == []


def test_goals_of_a_run_that_had_none_when_it_was_opened(visit):
    there = visit.go("#/primitives").page.evaluate(
        """async () => {
            const { GoalSpace } = await import('/page/space.js')
            const space = new GoalSpace(new AbortController().signal)
            const goals = { num_goals: 1, centers_m: [[0, 0, 0]], num_tries: [1], success_rate: [1] }
            const frame = { first_env_steps: 0, last_env_steps: 9, ...goals }
            return [[], [frame]].map(frames => {
                space.update({ frames, cell_size_m: 0.05 })
                return [space.root.textContent.includes('No goals'), space.root.contains(space.canvas)]
            })
        }"""
    )
    assert there == [[True, False], [False, True]]


def test_nothing_yet(visit, home):
    shutil.rmtree(home / "registry")
    for run in (home / "runs").iterdir():
        shutil.rmtree(run)
    page = visit.go().page
    page.get_by_text("tandem train --run-dir runs/cube").wait_for()
    write_status(home / "runs", "first")
    page.get_by_role("link", name="first").wait_for()
    visit.go("#/primitives").page.get_by_text("comes with tandem").first.wait_for()
    assert visit.complaints == []
    visit.go("#/runs/soon").page.get_by_text("No run 'soon' in").wait_for()
    write_status(home / "runs", "soon", name="elsewhere", published="elsewhere@1")
    page.get_by_role("heading", name="soon running").wait_for()
    page.get_by_text("The registry of this service has no version of elsewhere.").wait_for()


# --- for everybody, and nobody else ---------------------------------------------------------------------------------


def make_hostile(home):
    """Put markup into every free text of a run."""
    long = f"{HOSTILE} {'x' * 300}"
    known = {"incarnation": 0, "state": "alive", "heartbeat": "2026-01-01T00:00:00Z"}
    actor = ActorStatus(**known, name=HOSTILE, node=long, last_error=long)
    texts = {"name": HOSTILE, "last_error": long, "warnings": (HOSTILE, long), "published": HOSTILE}
    write_status(home / "runs", "cube", actors=(actor,), **texts)


def test_no_text_is_markup(visit, home):
    make_hostile(home)
    for place, table in (("#/", "Runs"), ("#/runs/cube", "Actors")):
        page = visit.go(place).page
        page.get_by_role("table", name=table, exact=True).get_by_text(HOSTILE).first.wait_for()
        assert page.locator("main img, main script").count() == 0
    assert complaints(visit) == []
    assert [url for url in visit.asked if url.endswith("/x")] == []


def test_a_phone_need_not_scroll_sideways(visit, home):
    make_hostile(home)
    page, usual = visit.page, visit.page.viewport_size
    page.set_viewport_size({"width": 360, "height": 740})
    settings = "".join(f"setting_{number}: {number}\n" for number in range(100))
    (home / "runs" / "cube" / "config.yaml").write_text(settings)
    write_trial(home / "runs", "x" * 100, HOSTILE, "ours", 0, 0.5, primitives=f"{HOSTILE}@1")
    for place, table in {"#/": "Runs", "#/runs/cube": "Actors", "#/tasks": "Tasks", "#/primitives": ""}.items():
        visit.go(place).page.get_by_role("table", name=table or "Versions of tiny", exact=True).wait_for()
        if place == "#/runs/cube":
            visit.points("alice/valid_fraction", 3)
            page.locator("rect.cell").first.wait_for()
            page.locator(".settings dt").nth(99).wait_for()
        widths = page.evaluate("[document.documentElement.scrollWidth, document.body.scrollWidth, innerWidth]")
        assert widths == [360] * 3
        assert page.locator("td").first.evaluate("cell => getComputedStyle(cell).display") == "flex"
        inner = "[...document.querySelectorAll('.scroll, .settings')].every(one => one.scrollWidth <= one.clientWidth)"
        assert page.evaluate(inner), place
    page.set_viewport_size(usual)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_light_and_dark(visit, scheme):
    page = visit.page
    page.emulate_media(color_scheme=scheme)
    visit.go("#/runs/cube").page.get_by_role("table", name="Actors").wait_for()
    visit.points("alice/valid_fraction", 3)
    luminance = page.evaluate(f"({LUMINANCE})(getComputedStyle(document.body).backgroundColor)")
    assert luminance > 0.8 if scheme == "light" else luminance < 0.05
    card = page.evaluate(f"({LUMINANCE})(getComputedStyle(document.querySelector('.card')).backgroundColor)")
    styles = dict.fromkeys(("h1", ".summary", ".hint", "td", "td a"), "color") | {".xtick text": "fill"}
    styles |= dict.fromkeys(("li.c0 .swatch", "li.c1 .swatch"), "backgroundColor")
    contrasts = {}
    for what, style in styles.items():
        script = f"({LUMINANCE})(getComputedStyle(document.querySelector('{what}')).{style})"
        low, high = sorted((card, page.evaluate(script) if page.locator(what).count() else 1 - round(card)))
        contrasts[what] = (high + 0.05) / (low + 0.05)
    # WCAG 2: 4.5 for text, 3 for what is drawn
    assert {what: x for what, x in contrasts.items() if x < (3.0 if "swatch" in what else 4.5)} == {}


def test_a_public_service_asks_for_its_token(shared, tmp_path):
    write_runs(tmp_path / "runs")
    with serve(tmp_path, host="0.0.0.0") as server:
        visit = Visit(shared.browser, server.url)
        page = visit.go("#/runs/cube").page
        page.get_by_label("Token").fill(WRONG)
        page.get_by_role("button", name="Log in").click()
        page.get_by_text("wrong token: enter the one").wait_for()
        page.get_by_label("Token").fill(TOKEN)
        page.keyboard.press("Enter")
        visit.points("alice/valid_fraction", 3)
        append(tmp_path / "runs", "cube", record(4))  # also the stream of events, which sends no header
        visit.points("alice/valid_fraction", 4)
        assert TOKEN not in page.evaluate("document.cookie + JSON.stringify({...localStorage, ...sessionStorage})")
        visit.go("#/").page.reload()
        page.get_by_role("link", name="cube", exact=True).wait_for()
        visit.context.close()
