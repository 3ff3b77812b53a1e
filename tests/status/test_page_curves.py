"""The curves of the page in a real browser: one run's, and those of several over one another."""

import csv
import shutil
from urllib.parse import parse_qs, urlsplit

import pytest

from service.registry.registry import Registry
from tests.status.browser import CHROMIUM, Visit, chromium
from tests.status.conftest import serve
from tests.status.runs import append, publish, record, write_runs, write_status

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH; on Debian: apt-get install chromium")

NBSP = "\u00a0"
LONG = 3000


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Beside "cube" and "old": "long" with one record that sticks out, and a study of two seeds."""
    home = tmp_path_factory.mktemp("curves")
    runs = home / "runs"
    write_runs(runs)
    publish(Registry(home / "registry"), "panda-cube")
    write_status(runs, "long", state="finished")
    values = {"bob/success_rate": 0.5}
    append(runs, "long", *(record(i, **values, **{"learner/kl": 9.0 if i == 1234 else 0.01}) for i in range(1, LONG)))
    write_status(runs, "hill", state="finished")
    values = {"climb/height": 3.0, "time/env_steps_per_s": 50.0}
    append(runs, "hill", *({"iteration": i, "env_steps": 1000 * i, **values} for i in range(1, 4)))
    goals = [[0, 0, 0.025, 0.01, 0.01, 0.03, 1]]
    append(runs, "hill", {"iteration": 3, "env_steps": 3000, "goals": goals}, file="goals.jsonl")
    (runs / "night").mkdir()
    (runs / "night" / "study.json").write_text("name: night\n")
    for seed in (0, 1):
        write_status(runs / "night", f"seed-{seed}", state="finished")
        append(
            runs / "night", f"seed-{seed}", *(record(i, **{"bob/success_rate": 0.25 + seed / 2}) for i in range(1, 4))
        )
        (runs / "night" / f"seed-{seed}" / "config.yaml").write_text(f"seed: {seed}\nname: panda-cube\n")
    return home


@pytest.fixture(scope="module")
def shared(home):
    """One page for all tests: its libraries take a browser seconds."""
    with chromium() as browser, serve(home) as server:
        yield Visit(browser, server.url)


@pytest.fixture
def visit(shared):
    shared.complaints.clear()
    yield shared
    shared.go("#/no/view").page.get_by_text("There is no page at this address.").wait_for()


def test_curves_and_what_is_read_from_them(visit):
    page = visit.go("#/runs/cube").page
    assert visit.points("bob/success_rate", 3) == [(1000, 0.125), (2000, 0.25), (3000, 0.375)]
    assert visit.points("alice/lifted_fraction", 3) == [(1000, 0.25), (2000, 0.25), (3000, 0.25)]
    legend = visit.chart("Bob on Alice's goals").locator(".legend li").first
    assert legend.inner_text() == f"all 37.5{NBSP}%"
    assert visit.chart("Bob on random goals").get_by_text("no values yet").is_visible()
    # the keyboard, and a cursor that all panels share
    plot = page.get_by_role("slider", name="Bob on Alice's goals")
    plot.press("Home")
    visit.wait("document.querySelectorAll('.chart .where')[0].textContent === 'at 1,000 env steps'")
    assert plot.get_attribute("aria-valuetext") == f"1,000 env steps: all 12.5{NBSP}%"
    plot.press("ArrowRight")
    visit.wait("document.querySelectorAll('.chart .where')[0].textContent === 'at 2,000 env steps'")
    plot.press("Escape")
    visit.wait("document.querySelectorAll('.chart .where')[0].textContent === ''")
    # the pointer
    box = visit.chart("Alice's proposals").locator(".plot").bounding_box()
    page.mouse.move(box["x"] + 60, box["y"] + 90)  # near the left end: the first point
    visit.wait("document.querySelectorAll('.plot .rule:not([hidden])').length > 1")
    assert legend.inner_text() == f"all 12.5{NBSP}%"
    page.mouse.move(5, 5)
    visit.wait("document.querySelectorAll('.plot .rule:not([hidden])').length === 0")
    # hours of learning are another axis; this run has none recorded
    page.locator(".board select").select_option("iterations")
    visit.wait("document.querySelectorAll('.canvas')[1].data[0].x.join() === '1,2,3'")


def test_a_long_run_is_thinned_smoothed_and_asked_for_anew(visit):
    page = visit.go("#/runs/long").page
    page.locator("summary").filter(has_text="learner").click()
    drawn = visit.points("learner/kl", 1000, "long")
    assert max(value for _, value in drawn) == 9.0  # the one record among three thousand that sticks out
    smooth = visit.traces("learner/kl", "long")[1]
    assert len(smooth["x"]) == 500
    assert max(smooth["y"]) < 0.6  # over 30 iterations, each point the mean of six
    panel = visit.chart("kl")
    # zoom with the pointer: 300 records around the one that sticks out, each a point of its own
    box = panel.locator(".canvas").bounding_box()
    left, width = box["x"] + 48, box["width"] - 60
    page.mouse.move(left + 0.38 * width, box["y"] + 80)
    page.mouse.down()
    page.mouse.move(left + 0.43 * width, box["y"] + 80, steps=4)
    page.mouse.up()
    page.get_by_role("button", name="Whole run").wait_for()
    visit.wait("document.querySelectorAll('.canvas')[0].data[0].x.length < 300")
    zoomed = visit.traces("learner/kl", "long")[0]
    assert zoomed["y"][zoomed["x"].index(1_234_000)] == 9.0
    assert 1_100_000 < zoomed["x"][0] < 1_234_000 < zoomed["x"][-1] < 1_350_000
    page.get_by_role("button", name="Whole run").click()
    visit.points("learner/kl", 1000, "long")
    page.locator("summary").filter(has_text="learner").click()
    page.get_by_label("logarithmic").check()
    visit.wait("document.querySelectorAll('.canvas')[0]._fullLayout.yaxis.type === 'log'")
    page.locator("summary").filter(has_text="learner").click()  # also what was closed meanwhile
    visit.wait("document.querySelector('.groups details[open] .canvas')._fullLayout.yaxis.type === 'log'")
    # all of it as CSV, and a picture
    with page.expect_download() as table:
        panel.get_by_role("link", name="CSV").click()
    rows = list(csv.DictReader(open(table.value.path())))  # noqa: SIM115
    assert (len(rows), rows[1233]["learner/kl"], rows[1233]["env_steps"]) == (LONG - 1, "9.0", "1234000")
    with page.expect_download() as picture:
        panel.get_by_role("button", name="Picture").click()
    with open(picture.value.path(), "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"
    page.get_by_label("Find a metric").fill("idle")
    assert page.locator("summary").filter(has_text="time").count() == 1
    visit.points("time/learner_idle_fraction", 1000, "long")
    page.evaluate("window.left = document.querySelector('.groups .canvas')")
    page.get_by_label("Find a metric").fill("none has this")
    visit.wait("!left.isConnected && !left._fullLayout")  # the library keeps nothing of it
    assert [said for said in visit.complaints if "404" not in said] == []  # this run has no goals


def test_a_run_of_another_method_shows_what_it_has(visit):
    """No empty panels of self-play: what it records is open."""
    page = visit.go("#/runs/hill").page
    assert visit.points("climb/height", 3, "hill") == [(1000, 3.0), (2000, 3.0), (3000, 3.0)]
    assert visit.chart("height").is_visible()
    assert visit.chart("Throughput").is_visible()
    visit.wait("document.querySelectorAll('.chart:not([hidden])').length === 3")  # time's, which is closed, has one
    for name in ("Bob on random goals", "Policy lag", "Alice's proposals"):
        visit.chart(name).wait_for(state="hidden")
    page.get_by_text("Bob's success").wait_for(state="hidden")
    page.get_by_role("heading", name="Goal map").wait_for(state="hidden")
    page.get_by_role("heading", name="Goals over the run").wait_for()  # which it has


def test_runs_are_found_sorted_and_compared(visit):
    page = visit.go("#/").page
    listed = page.locator("tbody tr a")
    page.get_by_role("link", name="night-seed-1").wait_for()
    page.get_by_label("Sort by").select_option("success")
    assert listed.all_inner_texts() == ["night-seed-1", "long", "cube", "old", "night-seed-0", "hill"]
    page.get_by_label("Show").select_option("ended")
    page.get_by_label("Find a run").fill("night")
    assert listed.all_inner_texts() == ["night-seed-1", "night-seed-0"]
    page.get_by_role("button", name="Choose all shown").click()
    page.get_by_label("Find a run").fill("long")
    page.get_by_label("Choose long").check()
    page.get_by_role("link", name="Compare 3 runs").click()
    page.get_by_role("heading", name="3 runs compared").wait_for()
    assert visit.points("bob/success_rate", 3, "night-seed-1")[2] == (3000, 0.75)
    assert visit.points("bob/success_rate", 3, "night-seed-0")[2] == (3000, 0.25)
    differing = page.get_by_role("table", name="What differs").locator("tbody tr")
    differing.first.wait_for()
    assert differing.all_inner_texts() == ["seed\t1\t0\t\u2013"]
    # a band from 0.25 to 0.75 for the study, and a line for the run of its own
    page.get_by_label("seeds as a band").check()
    visit.wait("document.querySelectorAll('.canvas')[0].data.some(trace => trace.name === 'night')")
    data = page.evaluate(
        "Object.fromEntries([...document.querySelectorAll('.canvas')[0].data].map(({name, y}) => [name, y[100]]))"
    )
    names = ("night highest", "night", "night lowest", "long")
    assert [data[name] for name in names] == pytest.approx([0.75, 0.5, 0.25, 0.5])
    # a run whose box is off has no curves
    page.get_by_label("seeds as a band").uncheck()
    page.get_by_label("Show long").uncheck()
    visit.wait("!document.querySelectorAll('.canvas')[0].data.some(trace => trace.name.startsWith('long'))")
    assert visit.complaints == []


def test_many_runs_are_asked_for_in_questions_that_every_proxy_takes(visit):
    ids = [f"night-{number:03d}-{'x' * 100}" for number in range(70)]
    visit.asked.clear()
    page = visit.go(f"#/compare/{','.join(ids)}").page
    page.get_by_text(f"no run '{ids[-1]}'").wait_for()
    questions = [url for url in visit.asked if "/v1/series?" in url]
    assert max(map(len, questions)) < 6000
    assert page.locator("figure.chart").get_by_role("link", name="CSV").count() == 0  # which is one question
    assert {id_ for url in questions for id_ in parse_qs(urlsplit(url).query)["runs"]} == set(ids)


def test_what_is_wrong_with_a_question_is_said_where_runs_are_compared(visit):
    page = visit.page
    page.route("**/v1/series?*", lambda route: route.fulfill(status=414, body="<html>"))
    page.route("**/v1/runs?*", lambda route: route.fulfill(status=500, json={"detail": "it broke"}))
    visit.go("#/compare/cube,old").page.get_by_text("It broke.").wait_for()
    page.unroute("**/v1/runs?*")
    page.get_by_text("the service answers 414").wait_for()
    page.unroute("**/v1/series?*")
    visit.points("bob/success_rate", 3)
    assert page.get_by_text("the service answers 414").count() == 0


def test_the_curves_of_a_run_that_has_ended_come_after_all(visit):
    page = visit.page
    page.route("**/v1/series?*", lambda route: route.fulfill(status=500, json={"detail": "it broke"}))
    visit.go("#/runs/old").page.get_by_text("This run cannot be followed: It broke.").wait_for()
    page.unroute("**/v1/series?*")
    visit.points("bob/success_rate", 3, "old")
    assert page.get_by_text("This run cannot be followed").count() == 0


def test_the_newest_runs_are_not_all_there_are(visit):
    page = visit.page
    page.route("**/v1/runs?*", lambda route: route.fulfill(json={"runs": [], "num_runs": 1001}))
    page.route("**/v1/runs/nope", lambda route: route.fulfill(status=404, json={"detail": "no run"}))
    states = visit.go("#/compare/cube,old,nope").page.get_by_role("table", name="Compared runs").locator(".chip")
    states.first.wait_for()
    assert states.all_inner_texts() == ["running", "finished", "not there"]
    for each in ("**/v1/runs?*", "**/v1/runs/nope"):
        page.unroute(each)


def test_the_newest_value_is_that_of_the_whole_run(visit):
    newest = visit.go("#/no/view").page.evaluate(
        """async () => {
            const { Board } = await import('/page/board.js')
            const panel = { title: '', hint: '', curves: [['bob/success_rate', '']] }
            const board = new Board([{ id: 'cube' }], [panel], new AbortController().signal)
            await board.refresh()
            const whole = await board.newest(['bob/success_rate'])
            board.range = [0, 1000]
            await board.refresh()
            const zoomed = await board.newest(['no/such', 'bob/success_rate'])
            const shown = board.data.get('cube').curves['bob/success_rate'].mean
            return [whole.get('cube'), shown.at(-1), zoomed.get('cube')]
        }"""
    )
    assert newest == [0.375, 0.25, 0.375]


def test_a_missing_value_is_a_gap_and_a_new_one_is_drawn(visit, home):
    write_status(home / "runs", "gap")
    append(home / "runs", "gap", *(record(i) for i in (1, 2, 3)), record(4, **{"bob/success_rate": None}), record(5))
    visit.go("#/runs/gap")
    assert visit.points("bob/success_rate", 5, "gap")[3:] == [(4000, None), (5000, 0.625)]
    (dot,) = visit.traces("bob/success_rate alone", "gap")  # which no line goes to
    assert (dot["x"], dot["y"]) == ([5000], [0.625])
    append(home / "runs", "gap", record(6))
    assert visit.points("bob/success_rate", 6, "gap")[5] == (6000, 0.75)
    assert visit.traces("bob/success_rate alone", "gap") == []
    shutil.rmtree(home / "runs" / "gap")  # other tests list the runs
