"""Pages as files: what they hold and allow, and the commands that write and open them."""

import base64
import gzip
import hashlib
import json
import re
import shutil
import webbrowser
from html.parser import HTMLParser

import jax
import mujoco
import pytest

from helpers.untrained import write_untrained_run
from jetbot_mjx import export, play
from jetbot_mjx.config import load_config
from jetbot_mjx.deployment import web_page
from jetbot_mjx.deployment.web_functions import WebFunctions, web_functions
from jetbot_mjx.deployment.web_modules import stored_hashes
from jetbot_mjx.deployment.web_page import page_text, write_web_page
from jetbot_mjx.deployment.web_scene import web_scene
from jetbot_mjx.errors import UserError
from onekernel import UnsupportedError, wasm


class Parts(HTMLParser):
    """The elements of a page with their attributes, and the text of scripts, styles and titles."""

    def __init__(self, text):
        super().__init__()
        self.elements, self._text = [], None
        self.texts = {"script": [], "style": [], "title": []}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag in self.texts:
            self.texts[tag].append("")
            self._text = tag

    def handle_data(self, data):
        if self._text:
            self.texts[self._text][-1] += data

    def handle_endtag(self, tag):
        if tag == self._text:
            self._text = None

    def scripts(self):
        """The scripts, as pairs of attributes and text."""
        attributes = [found for tag, found in self.elements if tag == "script"]
        return list(zip(attributes, self.texts["script"], strict=True))

    def data(self):
        """What the page was made of."""
        (text,) = (text for found, text in self.scripts() if found.get("id") == "data")
        return json.loads(text)

    def policy(self):
        """The content security policy: the sources of each directive."""
        (text,) = (x["content"] for _, x in self.elements if "http-equiv" in x)
        return {name: sources for name, *sources in (x.split() for x in text.split(";"))}


def data_of(title="run", **others):
    """What a page is made of, with no robot."""
    meta = {"title": title, "no_learner": None, "max_speed": 1.0, **others}
    return {"meta": meta, "module": "", "policies": [{"name": "final"}]}


def source(text):
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def test_a_page_may_run_its_own_scripts_and_nothing_else():
    parts = Parts(page_text(data_of()))
    policy = parts.policy()
    programs = [text for found, text in parts.scripts() if found.get("type") != "application/json"]
    assert len(programs) == 2
    assert {*policy.pop("script-src")} == {*map(source, programs), "'wasm-unsafe-eval'"}
    assert policy.pop("style-src") == [source(text) for text in parts.texts["style"]]
    assert policy == {
        "default-src": ["'none'"],
        "worker-src": ["blob:"],
        "img-src": ["data:", "blob:"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
    }
    # Nothing that the policy would not run, and nothing from anywhere else.
    for tag, attributes in parts.elements:
        assert not [name for name in attributes if name.startswith("on") or name == "style"], tag
        assert not {"src", "href"} & {*attributes}, tag
    for text in programs:
        assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|importScripts|eval)\b", text)
        assert not re.search(r"document\.cookie|localStorage", text)
        # The names of XML's namespaces are no addresses.
        assert {*re.findall(r"https?://[\w.]+", text)} <= {"http://www.w3.org"}


@pytest.mark.parametrize(
    "title",
    [
        "</title><script>alert(1)</script>",
        "</script><!-- <script>",
        'a "quoted" & <b>bold</b> one',
        "{{data}} {{engine}} {{app}} {{csp}}",
        "Strecke – ñ 走",
        r"\u003c \n",
    ],
)
def test_whatever_a_run_is_called_is_text(title):
    usual, parts = Parts(page_text(data_of())), Parts(page_text(data_of(title)))
    assert parts.texts["title"] == [f"{title} · jetbot_mjx"]
    assert parts.data() == data_of(title)
    assert [tag for tag, _ in parts.elements] == [tag for tag, _ in usual.elements]
    assert parts.scripts()[1:] == usual.scripts()[1:]
    assert parts.policy() == usual.policy()


@pytest.fixture
def functions_once(monkeypatch):
    """The functions of a page are written once, for all pages of one configuration."""
    written = []

    def once(*given):
        written[:] = written or [web_functions(*given)]
        return written[0]

    monkeypatch.setattr(web_page, "web_functions", once)


@pytest.mark.slow
@pytest.mark.usefixtures("functions_once")
def test_a_page_of_a_run_is_small_and_has_its_policies(here, capfd):
    # One that is as bad as untrained, an early checkpoint, a good one, and the last.
    run, config = here / "run", load_config("jetbot_egocentric")
    scores = {1024: 0.03, 2048: 0.3, 4096: 0.9}
    write_untrained_run(run, config, (0, *scores, 8192), scores)
    if jax.__version__ not in stored_hashes() and (reason := wasm.obstacle()):
        pytest.skip(reason)
    assert export.main([str(run), "--format", "web", "--checkpoint", "8192"]) == 0
    page = run / "page.html"
    told = capfd.readouterr().out
    assert "run/page.html, 0." in told
    assert "drivers: untrained, early, final, scripted, you; can be trained there" in told
    parts = Parts(page.read_text("utf-8"))
    data = parts.data()
    found = [(policy["name"], policy["env_steps"]) for policy in data["policies"]]
    assert found == [("untrained", 0), ("early", 2048), ("final", 8192)]
    kernels = [policy["layers"][0]["kernel"] for policy in data["policies"]]
    assert len({*kernels}) == 3
    assert page.stat().st_size <= 1.2e6
    assert len(gzip.compress(page.read_bytes())) <= 900_000
    (engine,) = (text for found, text in parts.scripts() if found.get("id") == "engine")
    engine_size = len(gzip.compress(base64.b64decode(data["module"]) + engine.encode()))
    assert engine_size <= 100_000
    # Another checkpoint is another page, and replaces this one.
    assert export.main([str(run), "--format", "web", "--checkpoint", "1024"]) == 0
    again = Parts(page.read_text("utf-8")).data()["policies"]
    assert [(one["name"], one["env_steps"]) for one in again] == [("untrained", 0), ("final", 1024)]
    assert {one.name for one in run.iterdir()} == {"checkpoints", "page.html"}


@pytest.fixture
def quick(monkeypatch):
    """Pages of nothing, which take no time to compile."""
    monkeypatch.setattr(web_page, "page_data", lambda _: data_of())


def test_a_page_of_a_shipped_policy_is_written_into_the_present_folder(quick, here, capfd):
    assert export.main(["pretrained:jetbot_egocentric", "--format", "web"]) == 0
    told = capfd.readouterr().out
    written = here / "runs" / "pretrained" / "jetbot_egocentric" / "page.html"
    assert Parts(written.read_text("utf-8")).data() == data_of()
    assert "runs/pretrained/jetbot_egocentric/page.html" in told
    assert (
        export.main(["pretrained:jetbot_egocentric", "--format", "web", "--output", "a/b.html"])
        == 0
    )
    assert (here / "a" / "b.html").read_bytes() == written.read_bytes()


def test_why_a_page_cannot_train_is_told(here, capfd, monkeypatch):
    data = data_of() | {
        "meta": {"title": "run", "max_speed": 1.0, "no_learner": "it takes no images"}
    }
    monkeypatch.setattr(web_page, "page_data", lambda _: data)
    assert export.main(["pretrained:jetbot_camera", "--format", "web"]) == 0
    told = capfd.readouterr().out
    assert "no training there, which needs the fused update: it takes no images" in told


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("formats", [["web,numpy"], ["web", "--format", "onnx"], ["web,all"]])
def test_a_page_is_no_file_of_a_folder(formats, refused):
    said = refused(export, "pretrained:jetbot_egocentric", "--format", *formats)
    assert "--format web writes a page, not a folder: give it alone" in said


@pytest.mark.usefixtures("quick")
def test_the_output_of_a_page_is_a_file(refused, here):
    (here / "folder").mkdir()
    said = refused(export, "pretrained:jetbot_egocentric", "--format", "web", "--output", "folder")
    assert "folder is a folder: name a file with --output, such as folder/page.html" in said


@pytest.mark.usefixtures("quick")
def test_a_place_that_cannot_be_written_is_told(refused, here):
    (here / "file").write_text("")
    said = refused(
        export, "pretrained:jetbot_egocentric", "--format", "web", "--output", "file/page.html"
    )
    assert "file cannot be written: Not a directory" in said


def test_without_a_linker_other_functions_are_refused_with_the_remedy(
    trained, refused, monkeypatch
):
    functions = WebFunctions({"own": "a module that is not stored"}, *[None] * 4)
    monkeypatch.setattr(web_page, "web_functions", lambda *_: functions)
    monkeypatch.setattr(shutil, "which", lambda _: None)
    wasm._linker.cache_clear()
    try:
        said = refused(export, trained, "--format", "web", "--output", "new/page.html")
    finally:
        wasm._linker.cache_clear()
    assert "no page of run: LLVM's linker wasm-ld is not installed: apt install lld" in said


def test_a_function_that_is_no_kernel_is_told(trained, refused, monkeypatch):
    def no_kernel(*_):
        raise UnsupportedError("the task uses pure_callback")

    monkeypatch.setattr(web_page, "web_functions", no_kernel)
    said = refused(export, trained, "--format", "web")
    assert "no page of run: the task uses pure_callback" in said


def test_a_page_that_cannot_be_completed_leaves_the_one_before(
    quick, trained, tmp_path, monkeypatch
):
    page = tmp_path / "page.html"
    write_web_page(trained, page)
    before = page.read_bytes()

    def full(path, content):
        path.with_name(".unfinished").write_bytes(content[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(page), "replace", lambda *_: full(page, before))
    with pytest.raises(UserError, match=r"page\.html cannot be written: No space left on device"):
        write_web_page(trained, page)
    assert page.read_bytes() == before


@pytest.fixture
def browser(monkeypatch):
    """A browser that is there, and the addresses that it was given."""
    opened = []

    def open_address(address):
        opened.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", open_address)
    return opened


@pytest.mark.usefixtures("quick")
def test_play_opens_the_page_of_a_run(browser, trained, here, capfd):
    shutil.copytree(trained, here / "run")
    assert play.main(["run", "--web"]) == 0
    assert browser == [(here / "run" / "page.html").resolve().as_uri()]
    told = capfd.readouterr().out
    assert "run/page.html" in told
    assert "no browser" not in told
    assert Parts((here / "run" / "page.html").read_text("utf-8")).data() == data_of()


@pytest.mark.usefixtures("quick")
def test_play_without_a_run_opens_the_page_of_a_shipped_policy(browser, here, capfd):
    assert play.main(["--web"]) == 0
    (address,) = browser
    assert address.startswith("file:///")
    assert address.endswith("/runs/pretrained/jetbot_egocentric/page.html")


@pytest.mark.usefixtures("quick")
def test_without_a_browser_the_file_is_named(here, capfd, monkeypatch):
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    assert play.main(["--web"]) == 0
    assert "no browser was found: open this file in one" in capfd.readouterr().out


@pytest.mark.usefixtures("quick")
def test_a_browser_that_is_not_wanted_is_neither_opened_nor_missed(browser, here, capfd):
    assert play.main(["--web", "--no-browser"]) == 0
    assert not browser
    told = capfd.readouterr().out
    assert "runs/pretrained/jetbot_egocentric/page.html" in told
    assert "browser was found" not in told


MODEL = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
    <material name="blue" rgba="0 0 1 1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <geom name="wall" type="box" size="0.1 0.2 0.3" pos="1 0 0" rgba="1 0 0 1"/>
    <body name="robot" pos="0 0 1">
      <freejoint/>
      <geom type="sphere" size="0.1" material="blue"/>
      <geom type="mesh" mesh="wedge" rgba="0 1 0 0.5"/>
      <geom type="mesh" mesh="wedge" rgba="0 1 0 1"/>
      <geom type="cylinder" size="0.1 0.2" rgba="1 1 1 0"/>
      <geom type="capsule" size="0.1 0.2" group="3"/>
    </body>
    <body name="goal" mocap="true"><geom type="ellipsoid" size="0.1 0.2 0.3"/></body>
  </worldbody>
</mujoco>
"""


def test_a_scene_has_what_can_be_seen():
    model = mujoco.MjModel.from_xml_string(MODEL)
    scene = web_scene(model)
    bodies = [model.body(body).name for body in scene.bodies]
    # The robot comes first, whatever stands before it in the model.
    assert bodies == ["robot", "world", "goal"]
    about = scene.about
    assert (about["bodies"], about["goal"]) == (3, 2)
    shown = [(part["body"], part["type"], part.get("mesh")) for part in about["geoms"]]
    assert shown == [
        (1, "box", None),
        (0, "sphere", None),
        (0, "mesh", 0),
        (0, "mesh", 0),
        (2, "ellipsoid", None),
    ]
    assert about["geoms"][0]["pos"] == [1, 0, 0]
    assert about["geoms"][1]["rgba"] == [0, 0, 1, 1]
    assert about["geoms"][0]["size"] == [0.1, 0.2, 0.3]
    # One mesh, though two parts show it: as many numbers as the model has.
    (mesh,) = about["meshes"]
    assert len(base64.b64decode(mesh["vertices"])) == model.mesh_vertnum[0] * 3 * 4
    assert len(base64.b64decode(mesh["faces"])) == model.mesh_facenum[0] * 3 * 4
