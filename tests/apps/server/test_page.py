"""The page in a real browser: Debian's Chromium, driven by Selenium. Skipped where they are not installed.

``TRILITENET_SCREENSHOTS`` names a folder for pictures of the page, to be looked at.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from tests.apps.server.conftest import TOKEN, FakeBackend, Running, encode, picture
from trilitenet.apps.server.application import create_app
from trilitenet.apps.server.problems import BusyError
from trilitenet.apps.server.service import Encoded
from trilitenet.apps.server.settings import Settings
from trilitenet.config import TASKS, Task, Thresholds
from trilitenet.formats.writers.native import read_schema
from trilitenet.inference.predictor import Predictor

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
CHROMEDRIVER = shutil.which("chromedriver")

pytestmark = pytest.mark.skipif(
    CHROMIUM is None or CHROMEDRIVER is None,
    reason="no Chromium with chromedriver here (Debian: apt install chromium chromium-driver)",
)


class Page:
    """The open page."""

    def __init__(self, driver: Any, downloads: Path) -> None:
        self.driver = driver
        self.downloads = downloads

    def __getitem__(self, identifier: str) -> Any:
        return self.driver.find_element(By.ID, identifier)

    def wait(self, condition: Callable[[], Any], seconds: float = 20) -> Any:
        return WebDriverWait(self.driver, seconds, poll_frequency=0.05).until(lambda _: condition())

    def script(self, text: str, *arguments: Any) -> Any:
        return self.driver.execute_script(text, *arguments)

    def open(self, url: str) -> None:
        self.driver.get(url)
        self.wait(lambda: "model tiny" in self["model"].text or self["token-form"].is_displayed())

    def choose(self, file: Path) -> None:
        self["file"].send_keys(str(file))

    def see(self, file: Path) -> str:
        self.choose(file)
        self.wait(lambda: self["summary"].text.endswith("."))
        return str(self["summary"].text)

    def pixel(self, x: float, y: float) -> list[int]:
        """Colour of the canvas at a place from 0 to 1."""
        values: list[int] = self.script(
            "const v = document.getElementById('view');"
            "return [...v.getContext('2d').getImageData(v.width * arguments[0], v.height * arguments[1], 1, 1).data]",
            x,
            y,
        )
        return values[:3]

    def set_range(self, identifier: str, value: float) -> None:
        self.script(
            "const e = document.getElementById(arguments[0]); e.value = arguments[1];"
            "e.dispatchEvent(new Event('input', {bubbles: true}))",
            identifier,
            value,
        )

    def resize(self, width: int, height: int, *, phone: bool = False) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 2 if phone else 1, "mobile": phone}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def scheme(self, name: str) -> None:
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def photograph(self, name: str) -> None:
        folder = os.environ.get("TRILITENET_SCREENSHOTS")
        if folder:
            self.driver.save_screenshot(str(Path(folder) / f"{name}.png"))

    def downloaded(self, name: str) -> Path:
        path = self.downloads / name
        self.wait(lambda: path.exists() and path.stat().st_size > 0)
        return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    downloads = tmp_path_factory.mktemp("downloads")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM or ""
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--disable-gpu",
        "--use-fake-device-for-media-stream",
        "--use-fake-ui-for-media-stream",
        "--window-size=1280,900",
        f"--user-data-dir={tmp_path_factory.mktemp('profile')}",
    ):
        options.add_argument(flag)
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(CHROMEDRIVER))
    yield Page(driver, downloads)
    driver.quit()


@pytest.fixture(scope="module")
def server() -> Iterator[Running]:
    running = Running(create_app(Predictor(FakeBackend()), "tiny", Settings(threads=2, drain=0.1)))
    yield running
    assert running.stop()


@pytest.fixture
def page(browser: Page, server: Running) -> Iterator[Page]:
    """The page, fresh and of desktop size; afterwards the browser must not have complained."""
    browser.resize(1280, 900)
    browser.scheme("light")
    browser.open(server.url)
    browser.driver.get_log("browser")
    yield browser
    complaints = [entry["message"] for entry in browser.driver.get_log("browser") if entry["level"] == "SEVERE"]
    # A refused request is logged by the browser itself; that is no fault of the page.
    assert [text for text in complaints if "Failed to load resource" not in text] == []


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "road.png"
    path.write_bytes(encode(picture(640, 360), "PNG"))
    return path


def test_a_photo_is_uploaded_and_what_is_seen_appears(page: Page, photo: Path) -> None:
    assert page["save-overlay"].get_attribute("disabled")
    assert page.see(photo) == "2 vehicles; drivable area 50 % of the picture; lane markings 13 %."
    assert page["view"].get_attribute("aria-label") == page["summary"].text
    assert page.script("const v = document.getElementById('view'); return [v.width, v.height]") == [640, 360]
    assert page.pixel(0.9, 0.1) == [30, 60, 90]
    tinted = np.round(0.45 * np.array([0, 158, 115]) + 0.55 * np.array([30, 60, 90]))
    np.testing.assert_allclose(page.pixel(0.1, 0.9), tinted, atol=2)
    stages = [row.text.rsplit(" ", 1)[0] for row in page["timing"].find_elements(By.TAG_NAME, "tr")]
    assert stages == ["decode", "preprocess", "queue", "network", "postprocess", "round trip"]
    assert _overlaps(page) == []
    page.photograph("photo")


def _overlaps(page: Page) -> list[str]:
    """Labels whose text lies under a control beside it."""
    names: list[str] = page.script(
        "return [...document.querySelectorAll('.layer')].filter((layer) => {"
        "const range = document.createRange(); range.selectNodeContents(layer.querySelector('label'));"
        "const text = range.getBoundingClientRect();"
        "const slider = layer.querySelector('input[type=range]').getBoundingClientRect();"
        "return text.right > slider.left && text.left < slider.right"
        "  && text.bottom > slider.top && text.top < slider.bottom;"
        "}).map((layer) => layer.innerText)"
    )
    return names


def test_masks_lie_where_the_service_says(page: Page, server: Running, photo: Path) -> None:
    page.see(photo)
    page.script("for (const n of ['detection', 'drivable']) document.getElementById('show-' + n).click()")
    page.set_range("opacity-lane", 100)
    shown = np.array(
        page.script(
            "const v = document.getElementById('view');"
            "return [...v.getContext('2d').getImageData(0, 0, v.width, v.height).data]"
        )
    )
    yellow = (shown.reshape(360, 640, 4)[..., :3] == (240, 228, 66)).all(axis=2)
    np.testing.assert_array_equal(yellow, server.app.service.predictor(photo).lane)


def test_toggles_and_opacity_draw_again(page: Page, photo: Path) -> None:
    page.see(photo)
    before = page.pixel(0.1, 0.9)
    page["show-drivable"].click()
    assert page.pixel(0.1, 0.9) == [30, 60, 90]
    page["show-drivable"].click()
    assert page.pixel(0.1, 0.9) == before
    page.set_range("opacity-drivable", 100)
    assert page.pixel(0.1, 0.9) == [0, 158, 115]
    edge = (0.25 - 0.1, 0.5)
    assert page.pixel(*edge) != page.pixel(0.05, 0.4)
    page["show-detection"].click()
    page.set_range("opacity-drivable", 10)
    np.testing.assert_allclose(page.pixel(*edge), page.pixel(0.05, edge[1]), atol=2)


def test_layers_can_be_hidden_where_the_picture_is_transparent(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "clear.png"
    Image.new("RGBA", (640, 360)).save(path)
    page.see(path)
    opaque = "return document.getElementById('view').getContext('2d').getImageData(9, 350, 1, 1).data[3] / 255"
    for _ in range(4):
        page["show-drivable"].click()
    assert page.script(opaque) == pytest.approx(0.45, abs=0.01)
    page["show-drivable"].click()
    assert page.script(opaque) == 0


def test_labels_do_not_hide_each_other(page: Page) -> None:
    boxes = [
        {"xyxy": [100, 100, 300, 200], "confidence": 0.9, "class_id": 0, "class_name": "vehicle"},
        {"xyxy": [105, 102, 200, 190], "confidence": 0.8, "class_id": 0, "class_name": "vehicle"},
        {"xyxy": [60, 101, 120, 190], "confidence": 0.7, "class_id": 0, "class_name": "vehicle"},
        {"xyxy": [100, 300, 300, 350], "confidence": 0.6, "class_id": 0, "class_name": "vehicle"},
        {"xyxy": [102, 102, 198, 188], "confidence": 0.5, "class_id": 0, "class_name": "vehicle"},
    ]
    said = page.script(
        "const { drawFrame } = await import('/draw.js'); const said = [];"
        "const view = document.createElement('canvas'); const write = CanvasRenderingContext2D.prototype.fillText;"
        "CanvasRenderingContext2D.prototype.fillText = function (text) { said.push(text); };"
        "const picture = await createImageBitmap(new ImageData(640, 360)); const show = { show: true, opacity: 1 };"
        "drawFrame(view, { picture, boxes: arguments[0] },"
        "  { detection: show, drivable: show, lane: show, confidence: 0 });"
        "CanvasRenderingContext2D.prototype.fillText = write; return said",
        boxes,
    )
    assert said == ["vehicle 0.90", "0.80", "0.70", "vehicle 0.60"]


def test_the_slider_chooses_boxes(page: Page, photo: Path) -> None:
    page.see(photo)
    counts = {}
    for value in (0.05, 0.3, 0.6, 0.95):
        page.set_range("confidence", value)
        counts[value] = page["objects-count"].get_attribute("textContent").strip()
    assert counts == {0.05: "(3)", 0.3: "(2)", 0.6: "(1)", 0.95: "(0)"}
    assert page["summary"].text.startswith("no vehicle;")


def test_the_slider_begins_at_the_confidence_that_is_served(browser: Page, photo: Path) -> None:
    predictor = Predictor(FakeBackend(), Thresholds(confidence=0.6062))
    running = Running(create_app(predictor, "tiny", Settings(threads=1, drain=0.1)))
    try:
        browser.open(running.url)
        assert browser["confidence"].get_attribute("value") == "0.6062"
        assert browser["confidence-text"].text == "0.61"
        assert browser.see(photo).startswith("1 vehicle;")
        browser["confidence"].send_keys(Keys.HOME)
        assert browser["confidence-text"].text == "0.06"
    finally:
        assert running.stop()


@pytest.mark.parametrize(
    ("classes", "tasks", "title", "boxes"),
    [
        (("vehicle",), ("detection",), "Vehicles", "Vehicles"),
        (("bus", "person"), TASKS, "Objects, drivable area and lane markings", "Objects"),
        (("vehicle",), ("drivable", "lane"), "Drivable area and lane markings", "Vehicles"),
    ],
)
def test_the_page_names_what_the_model_sees(
    browser: Page, photo: Path, classes: tuple[str, ...], tasks: tuple[Task, ...], title: str, boxes: str
) -> None:
    backend = FakeBackend()
    backend.card = dataclasses.replace(backend.card, class_names=classes, tasks=tasks)
    running = Running(create_app(Predictor(backend), "tiny", Settings(threads=1, drain=0.1)))
    try:
        browser.open(running.url)
        assert browser["tasks"].text == title
        assert browser["name-detection"].text == boxes
        assert browser["opacity-detection"].get_attribute("aria-label") == f"Opacity of {boxes.lower()}"
        assert {name for name in TASKS if browser[f"show-{name}"].is_enabled()} == set(tasks)
        assert browser["confidence"].is_displayed() == ("detection" in tasks)
        if tasks == TASKS:
            assert browser.see(photo).startswith("2 buses;")
            browser.set_range("confidence", 0.95)
            assert browser["summary"].text.startswith("no objects;")
    finally:
        assert running.stop()


def test_what_is_counted_is_named_in_the_plural(page: Page) -> None:
    names = {
        "bus": "buses",
        "person": "persons",
        "bicycle": "bicycles",
        "traffic light": "traffic lights",
        "ambulance": "ambulances",
        "box": "boxes",
        "couch": "couches",
    }
    said = page.script("const { plural } = await import('/client.js'); return arguments[0].map(plural)", list(names))
    assert said == list(names.values())


def test_overlay_and_json_are_saved(page: Page, server: Running, photo: Path) -> None:
    page.see(photo)
    page["save-overlay"].click()
    with Image.open(page.downloaded("road-overlay.png")) as overlay:
        assert overlay.size == (640, 360)
        np.testing.assert_array_equal(np.asarray(overlay)[324, 64, :3], page.pixel(0.1, 0.9))
    page.set_range("confidence", 0.6)
    page["save-json"].click()
    saved = json.loads(page.downloaded("road.json").read_text())
    expected = server.app.service.predictor(photo).to_dict()
    assert saved["drivable"] == expected["drivable"]
    assert saved["boxes"] == expected["boxes"][:1]
    assert saved["source"] == "road"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("broken.jpg", encode(picture(640, 360))[:900], "broken or truncated"),
        ("letter.txt", b"Dear service", "not a JPEG, PNG or WebP"),
        ("empty.png", b"", "empty"),
        ("broken.mp4", b"\0\0\0\x18ftypmp42 no clip", "cannot be played"),
    ],
)
def test_a_broken_file_is_explained_and_the_page_goes_on(
    page: Page, photo: Path, tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    page.choose(path)
    page.wait(lambda: message in page["error"].text)
    assert page["error"].get_attribute("role") == "alert"
    if name == "broken.jpg":
        page.photograph("error")
    page.see(photo)
    assert not page["error"].is_displayed()


@pytest.mark.parametrize("name", ["broken.jpg", "broken.mp4"])
def test_a_broken_file_leaves_what_was_shown_whole(page: Page, photo: Path, tmp_path: Path, name: str) -> None:
    assert not page["timing-details"].is_displayed()
    summary = page.see(photo)
    assert page["timing-details"].is_displayed()
    path = tmp_path / name
    path.write_bytes(b"\xff\xd8\xff no picture")
    page.choose(path)
    page.wait(lambda: page["error"].text.endswith("."))
    assert page["summary"].text == summary
    (page.downloads / "road.json").unlink(missing_ok=True)
    page["save-json"].click()
    assert json.loads(page.downloaded("road.json").read_text())["source"] == "road"


def test_the_keyboard_is_enough(page: Page, photo: Path) -> None:
    page.see(photo)
    page.script("document.activeElement.blur(); window.scrollTo(0, 0)")
    order: list[str] = []
    for _ in range(30):
        webdriver.ActionChains(page.driver).send_keys(Keys.TAB).perform()
        focused = page.script("return document.activeElement.id || document.activeElement.className || 'summary'")
        if focused in order[-1:] or (order and focused == order[0]):
            break
        order.append(focused)
        if focused not in {"BODY", ""}:
            outline = page.script(
                "const e = document.activeElement;"
                "return getComputedStyle(e.matches('.file input') ? e.nextElementSibling : e).outlineStyle"
            )
            assert outline != "none", f"focus on {focused} cannot be seen"
    wanted = ["skip", "file", "camera", "rate", "save-overlay", "save-json", "show-detection", "opacity-detection"]
    wanted += ["show-drivable", "opacity-drivable", "show-lane", "opacity-lane", "confidence"]
    assert [name for name in order if name in wanted] == wanted
    page["show-drivable"].send_keys(Keys.SPACE)
    assert page.pixel(0.1, 0.9) == [30, 60, 90]
    page["confidence"].send_keys(Keys.END)
    assert page["confidence-text"].text == "0.95"
    page["confidence"].send_keys(Keys.HOME, Keys.ARROW_RIGHT)
    assert page["confidence-text"].text == "0.06"
    page["save-json"].send_keys(Keys.ENTER)
    page.downloaded("road.json")


def test_everything_has_a_name_for_screen_readers(page: Page, photo: Path) -> None:
    page.see(photo)
    controls = page.driver.find_elements(By.CSS_SELECTOR, "input, button, select, canvas, summary, progress")
    nameless = [control.get_attribute("id") for control in controls if not control.accessible_name]
    # Hidden ones have no name in the accessibility tree.
    hidden = {control.get_attribute("id") for control in controls if not control.is_displayed()}
    assert set(nameless) <= hidden
    assert page["summary"].aria_role == "status"
    assert page.script("return document.documentElement.lang") == "en"
    headings = [heading.tag_name for heading in page.driver.find_elements(By.CSS_SELECTOR, "h1, h2, h3")]
    assert headings == ["h1", "h2", "h2"]


@pytest.mark.parametrize("width", [320, 390])
def test_it_fits_a_phone(page: Page, photo: Path, width: int) -> None:
    page.resize(width, 780, phone=True)
    page.see(photo)
    assert page.script("return document.documentElement.scrollWidth") <= width
    small = page.script(
        "return [...document.querySelectorAll('button, select, .button, summary')]"
        ".filter((e) => e.offsetParent && e.getBoundingClientRect().height < 24).map((e) => e.id)"
    )
    assert small == []
    assert _overlaps(page) == []
    drawn, shown, letters = page.script(
        "const v = document.getElementById('view');"
        "return [v.width, v.clientWidth, parseFloat(v.getContext('2d').font.split(' ')[1])]"
    )
    assert letters * shown / drawn >= 9.9  # letters of at least 10 pixels of the page
    page.photograph(f"phone-{width}")


def test_dark_and_light_can_both_be_read(page: Page, photo: Path) -> None:
    page.see(photo)
    backs = []
    for scheme in ("light", "dark"):
        page.scheme(scheme)
        for selector in ("h1", ".hint", "#summary", ".primary", "#camera", "td", "summary span"):
            ink, back = page.script(
                "let e = document.querySelector(arguments[0]); const ink = getComputedStyle(e).color;"
                "while (getComputedStyle(e).backgroundColor === 'rgba(0, 0, 0, 0)') e = e.parentElement;"
                "return [ink, getComputedStyle(e).backgroundColor]",
                selector,
            )
            assert _contrast(ink, back) >= 4.5, (scheme, selector, ink, back)
        backs.append(page.script("return getComputedStyle(document.body).backgroundColor"))
        page.photograph(f"desktop-{scheme}")
        page.resize(390, 844, phone=True)
        page.photograph(f"phone-{scheme}")
        page.resize(1280, 900)
    assert backs[0] != backs[1]


def _contrast(ink: str, back: str) -> float:
    """Contrast ratio of WCAG 2.1 of two CSS colours."""
    luminances = []
    for colour in (ink, back):
        channels = np.array([float(part) for part in colour.strip("rgba()").split(",")[:3]]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        luminances.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(luminances) + 0.05) / (min(luminances) + 0.05)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds in which the picture grows lighter."""
    return _write_clip(tmp_path_factory.mktemp("clip") / "drive.webm", frames=30, rate=10)


def _write_clip(path: Path, frames: int, rate: float, *, noise: int = 0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), rate, (320, 192))
    if not writer.isOpened():
        pytest.skip("this OpenCV cannot write WebM")
    random = np.random.default_rng(0)
    for index in range(frames):
        writer.write(np.full((192, 320, 3), 8 * index % 256, np.uint8) + _noise(random, 192, 320, noise))
    writer.release()
    return path


def _noise(random: np.random.Generator, height: int, width: int, most: int) -> NDArray[np.uint8]:
    return random.integers(0, most, (height, width, 3), np.uint8, endpoint=True)


def test_a_clip_is_seen_in_chunks_with_progress(page: Page, server: Running, clip: Path) -> None:
    batches = _counted(server, "/v1/predict/batch")
    page.choose(clip)
    page.wait(lambda: page["progress-row"].is_displayed())
    page.wait(lambda: not page["progress-row"].is_displayed() and page["player"].is_displayed())
    frames = int(page["seek"].get_attribute("max")) + 1
    assert 13 <= frames <= 16
    assert _counted(server, "/v1/predict/batch") - batches == 2
    page.set_range("seek", 1)
    page.wait(lambda: page["seek-text"].text.startswith("2 /"))
    early = page.pixel(0.9, 0.1)
    page.set_range("seek", frames - 2)
    page.wait(lambda: page["seek-text"].text.startswith(f"{frames - 1} /"))
    assert page.pixel(0.9, 0.1)[0] > early[0] + 100
    page.photograph("clip")
    page["play"].click()
    page.wait(lambda: page["seek-text"].text.startswith(f"{frames} /"))
    page["save-json"].click()
    saved = json.loads(page.downloaded("drive.json").read_text())
    jsonschema.Draft202012Validator(read_schema()).validate(saved)
    assert saved["source"] == "drive"
    assert [entry["frame"] for entry in saved["frames"]] == list(range(frames))
    assert saved["frames"][5]["timestamp"] == 1.0
    page["save-clip"].click()
    assert page.downloaded("drive.webm").read_bytes()[:4] == b"\x1a\x45\xdf\xa3"


def test_a_clip_plays_at_its_speed_however_often_it_is_paused(page: Page, clip: Path) -> None:
    page.script("document.getElementById('rate').value = '2'")
    page.choose(clip)
    page.wait(lambda: page["player"].is_displayed() and not page["progress-row"].is_displayed())
    page.wait(lambda: page["seek-text"].text.startswith("1 /"))
    milliseconds = page.driver.execute_async_script(
        "const [done] = arguments; const start = performance.now(); const seek = document.getElementById('seek');"
        "for (let i = 0; i < 3; i += 1) document.getElementById('play').click();"
        "(function look() { seek.value >= 4 ? done(performance.now() - start) : setTimeout(look, 5); })()"
    )
    assert milliseconds > 1900  # four frames at two a second
    page.set_range("seek", 0)
    page["play"].click()
    assert page["play"].text == "Pause"
    page["save-clip"].click()
    assert page["play"].text == "Play"
    assert not any(page[name].is_enabled() for name in ("play", "seek"))  # which would change what is recorded
    page.downloaded("drive.webm")
    page.wait(lambda: page["play"].is_enabled() and page["seek"].is_enabled())


def test_a_clip_is_saved_as_what_the_browser_records(page: Page, clip: Path) -> None:
    page.script(
        "document.getElementById('rate').value = '2'; window.MediaRecorder = class {"
        "  static isTypeSupported(type) { return type === 'video/mp4'; }"
        "  constructor(stream, options) {"
        "    if (options?.mimeType !== 'video/mp4') throw new DOMException('', 'NotSupportedError');"
        "    this.mimeType = 'video/mp4;codecs=avc1';"
        "  }"
        "  start() {}"
        "  stop() { this.ondataavailable({ data: new Blob(['film']) }); this.onstop(); }"
        "}; const real = URL.createObjectURL;"
        "URL.createObjectURL = (blob) => { window.saved = blob.type; return real(blob); }"
    )
    page.choose(clip)
    page.wait(lambda: page["save-clip"].is_displayed() and page["save-clip"].is_enabled())
    page["save-clip"].click()
    assert page.downloaded("drive.mp4").read_bytes() == b"film"
    assert page.script("return window.saved") == "video/mp4"
    page.script("MediaRecorder.isTypeSupported = () => false")
    page.choose(clip)
    page.wait(lambda: page["save-clip"].get_attribute("hidden"))


def test_another_picture_ends_the_saving_of_a_clip(page: Page, clip: Path, photo: Path) -> None:
    page.script("document.getElementById('rate').value = '2'")
    page.choose(clip)
    page.wait(lambda: page["player"].is_displayed() and not page["progress-row"].is_displayed())
    page["save-clip"].click()
    page.wait(lambda: page["save-clip"].text.startswith("Saving 2"))
    page.choose(photo)
    page.wait(lambda: page["error"].text == "The clip was not saved, as something else was opened.")
    page.wait(lambda: not page["player"].is_displayed())
    page.choose(clip)
    page.wait(lambda: page["player"].is_displayed() and not page["progress-row"].is_displayed())
    assert page["save-clip"].text == "Save clip"
    assert all(page[name].is_enabled() for name in ("save-clip", "play", "seek"))


def test_frames_for_which_there_was_no_time_are_asked_for_again(
    page: Page, server: Running, clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    see = server.app.service.see
    asked: list[int] = []

    async def busy(*arguments: Any, **options: Any) -> Any:
        asked.append(1)
        if len(asked) == 3:
            raise BusyError("deadline", "the image waited too long")
        return await see(*arguments, **options)

    monkeypatch.setattr(server.app.service, "see", busy)
    page.choose(clip)
    page.wait(lambda: page["progress-row"].is_displayed())
    page.wait(lambda: not page["progress-row"].is_displayed() and page["player"].is_displayed())
    assert not page["error"].is_displayed()
    assert len(asked) == int(page["seek"].get_attribute("max")) + 2  # that frame alone


def test_a_webp_that_exif_may_turn_is_sent_as_it_is_shown(
    page: Page, server: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    see = server.app.service.see
    sent: list[tuple[str, int, int]] = []

    async def noted(image: Encoded, *arguments: Any, **options: Any) -> Any:
        sent.append((image.header.kind, image.header.width, image.header.height))
        return await see(image, *arguments, **options)

    monkeypatch.setattr(server.app.service, "see", noted)
    turn = Image.Exif()
    turn[0x0112] = 6
    Image.new("RGB", (64, 48)).save(tmp_path / "turned.webp", exif=turn)
    Image.new("RGB", (64, 48)).save(tmp_path / "plain.webp")
    for name in ("turned", "plain"):
        page.choose(tmp_path / f"{name}.webp")
        page.wait(lambda: len(sent) == (1 if name == "turned" else 2))  # noqa: B023 - called here alone
    assert sent == [("JPEG", 64, 48), ("WEBP", 64, 48)]


def test_a_clip_can_be_stopped(page: Page, clip: Path) -> None:
    page.script("document.getElementById('rate').value = '10'")
    page.choose(clip)
    page.wait(lambda: page["stop"].is_displayed())
    page["stop"].click()
    page.wait(lambda: not page["progress-row"].is_displayed())
    assert not page["error"].is_displayed()


def test_a_clip_that_is_too_long_to_be_seen_whole_says_so(page: Page, tmp_path: Path) -> None:
    page.script("document.getElementById('rate').value = '10'")
    page.choose(_write_clip(tmp_path / "long.webm", frames=40, rate=1))
    page.wait(lambda: "first 30 s of 40 s" in page["error"].text)
    page["stop"].click()
    page.wait(lambda: not page["stop"].is_displayed())
    assert "fewer frames per second" in page["error"].text


def _counted(server: Running, route: str) -> float:
    name = "trilitenet_requests_total"
    labels = {"route": route, "method": "POST", "status": "200"}
    return server.app.service.metrics.registry.get_sample_value(name, labels) or 0.0


def test_the_camera_runs_until_it_is_stopped(page: Page, server: Running) -> None:
    before = _counted(server, "/v1/predict")
    page["camera"].click()
    page.wait(lambda: page["view"].is_displayed() and _counted(server, "/v1/predict") >= before + 3)
    page.photograph("camera")
    page["stop"].click()
    page.wait(lambda: not page["stop"].is_displayed())
    time.sleep(0.3)
    settled = _counted(server, "/v1/predict")
    time.sleep(0.5)
    assert _counted(server, "/v1/predict") == settled
    assert page["save-overlay"].is_enabled()
    assert not page["error"].is_displayed()


def test_a_camera_that_is_lost_ends_the_job(page: Page, server: Running) -> None:
    page.script(
        "const real = navigator.mediaDevices.getUserMedia.bind(navigator.mediaDevices);"
        "navigator.mediaDevices.getUserMedia = async (wanted) => (window.lent = await real(wanted))"
    )
    before = _counted(server, "/v1/predict")
    page["camera"].click()
    page.wait(lambda: _counted(server, "/v1/predict") >= before + 2)
    page.script("for (const track of window.lent.getTracks()) track.stop()")
    page.wait(lambda: page["error"].text == "The camera is gone.")
    assert not page["stop"].is_displayed()


def test_the_camera_shows_nothing_of_the_clip_before_it(page: Page, server: Running, clip: Path) -> None:
    page.script("document.getElementById('rate').value = '10'")
    page.choose(clip)
    page.wait(lambda: page["progress-row"].is_displayed())
    assert not page["save-clip"].is_enabled()  # until all of it has been seen
    before = _counted(server, "/v1/predict")
    page["camera"].click()
    page.wait(lambda: _counted(server, "/v1/predict") >= before + 2)
    assert not page["progress-row"].is_displayed()
    assert page.script("return document.body.getAttribute('aria-busy')") is None
    page["stop"].click()
    page.wait(lambda: not page["stop"].is_displayed())


def test_waiting_leaves_nothing_behind(page: Page) -> None:
    left = page.driver.execute_async_script(
        "const [done] = arguments; const stop = new AbortController(); let count = 0;"
        "for (const [name, step] of [['addEventListener', 1], ['removeEventListener', -1]]) {"
        "  const real = stop.signal[name].bind(stop.signal);"
        "  stop.signal[name] = (...all) => { count += step; return real(...all); };"
        "}"
        "import(new URL('client.js', document.baseURI)).then(async ({ pause }) => {"
        "  for (let i = 0; i < 5; i += 1) await pause(1, stop.signal);"
        "  const rest = count; const last = pause(1e6, stop.signal).catch((error) => done([rest, error.name]));"
        "  stop.abort();"
        "}, (error) => done(String(error)))"
    )
    assert left == [0, "AbortError"]


def test_a_dropped_photo_is_taken(page: Page, photo: Path) -> None:
    page.script(
        "const bytes = Uint8Array.from(arguments[0]); const transfer = new DataTransfer();"
        "transfer.items.add(new File([bytes], 'dropped.png', {type: 'image/png'}));"
        "document.body.dispatchEvent(new DragEvent('drop', {dataTransfer: transfer, bubbles: true, cancelable: true}))",
        list(photo.read_bytes()),
    )
    page.wait(lambda: page["summary"].text.startswith("2 vehicles"))


def test_a_huge_photo_is_made_smaller_before_it_is_sent(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "huge.jpg"
    path.write_bytes(encode(picture(4000, 1000)))
    page.see(path)
    assert page.script("return document.getElementById('view').width") == 2560


@pytest.mark.parametrize(
    "limits",
    [{"max_pixels": 30_000}, {"max_side": 200}, {"max_body": 12_000}, {"max_pixels": 30_000, "max_body": 3_000}],
)
def test_pictures_are_sent_as_the_service_takes_them(browser: Page, tmp_path: Path, limits: dict[str, Any]) -> None:
    app = create_app(Predictor(FakeBackend()), "tiny", Settings(threads=1, drain=0.1, **limits))
    running = Running(app)
    try:
        browser.open(running.url)
        path = tmp_path / "noisy.png"
        Image.fromarray(_noise(np.random.default_rng(0), 300, 400, 255)).save(path)
        assert browser.see(path).startswith("2 vehicles")
        width, height = browser.script("const v = document.getElementById('view'); return [v.width, v.height]")
        assert width * height <= app.service.settings.max_pixels
        assert max(width, height) <= app.service.settings.max_side
        assert width / height == pytest.approx(4 / 3, rel=0.02)
        if "max_body" not in limits:
            assert width * height > 28_000  # no smaller than must be
        browser.choose(_write_clip(tmp_path / "noisy.webm", frames=20, rate=10, noise=255))
        browser.wait(lambda: browser["player"].is_displayed() and not browser["progress-row"].is_displayed())
        assert 9 <= int(browser["seek"].get_attribute("max")) + 1 <= 11
        assert not browser["error"].is_displayed()
        refused = [
            sample
            for metric in app.service.metrics.registry.collect()
            for sample in metric.samples
            if sample.name == "trilitenet_rejects_total" and sample.value
        ]
        assert refused == []
    finally:
        assert running.stop()


def _open_bitmaps(page: Page) -> int:
    return int(page.script("return window.bitmaps.filter((bitmap) => bitmap.width > 0).length"))


def _refuse(page: Page, status: int, condition: str) -> None:
    """Let requests whose `pictures` meet a condition be refused; `window.sent` takes the number and bytes of all."""
    page.script(
        "window.bitmaps = []; const decode = window.createImageBitmap;"
        "window.createImageBitmap = async (...of) => {"
        "  const bitmap = await decode(...of); window.bitmaps.push(bitmap); return bitmap;"
        "}"
    )
    page.script(
        "const [status] = arguments; const real = window.fetch; window.sent = [];"
        "window.fetch = async (path, options) => {"
        "  const { body } = options; const pictures = body instanceof FormData ? body.getAll('images') : [body];"
        "  window.sent.push([pictures.length, pictures[0].size]);"
        f"  if (!({condition})) return real(path, options);"
        "  return new Response(JSON.stringify({ error: { message: 'too much' } }), { status });"
        "}",
        status,
    )


@pytest.mark.parametrize("status", [408, 413])
def test_a_clip_that_is_too_much_at_once_is_sent_in_fewer_frames(page: Page, clip: Path, status: int) -> None:
    _refuse(page, status, "pictures.length > 3")
    page.choose(clip)
    page.wait(lambda: page["player"].is_displayed() and not page["progress-row"].is_displayed())
    frames = int(page["seek"].get_attribute("max")) + 1
    counts = [count for count, _ in page.script("return window.sent")]
    assert counts[:4] == [8, 4, 2, 2]
    assert max(counts[2:]) == 2  # once is enough
    assert sum(counts[2:]) == frames
    assert not page["error"].is_displayed()


@pytest.mark.parametrize("status", [408, 413])
def test_a_photo_that_is_too_much_is_sent_smaller(page: Page, tmp_path: Path, status: int) -> None:
    _refuse(page, status, "pictures[0].size > 150000")
    path = tmp_path / "noisy.png"
    Image.fromarray(_noise(np.random.default_rng(0), 300, 800, 255)).save(path)
    assert page.see(path).startswith("2 vehicles")
    sizes = [size for _, size in page.script("return window.sent")]
    assert sizes[0] == path.stat().st_size
    assert sizes[-1] <= 150_000
    assert all(later <= earlier / 2 for earlier, later in itertools.pairwise(sizes))
    assert _open_bitmaps(page) == 1, "that which is shown"


def test_a_photo_that_is_always_too_much_is_given_up(page: Page, photo: Path) -> None:
    _refuse(page, 408, "true")
    page.choose(photo)
    page.wait(lambda: page["error"].text == "Too much.")
    assert page["summary"].text == ""
    assert _open_bitmaps(page) == 0


def test_the_times_of_a_clip_say_what_they_are_of(page: Page, clip: Path) -> None:
    page.script(
        "const real = Response.prototype.json; Response.prototype.json = async function () {"
        "  const answer = await real.call(this); for (const one of answer.results ?? []) one.batch = 5; return answer;"
        "}"
    )
    page.choose(clip)
    page.wait(lambda: page["player"].is_displayed() and not page["progress-row"].is_displayed())
    page.wait(lambda: page["seek-text"].text.startswith("1 /"))
    rows = dict(row.text.rsplit(" ", 1) for row in page["timing"].find_elements(By.TAG_NAME, "tr"))
    assert list(rows)[3:] == [
        "network, for 5 pictures at once",
        "postprocess",
        "round trip of 8 frames",
        "a frame's share",
    ]
    share = float(rows["a frame's share"])
    assert share == pytest.approx(float(rows["round trip of 8 frames"]) / 8, abs=0.2)
    assert abs(float(page["timing-total"].text.strip(": ms")) - share) <= 0.6


def test_nothing_comes_from_elsewhere(page: Page, server: Running, photo: Path) -> None:
    page.see(photo)
    names = page.script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert names
    assert all(name.startswith((server.url, "blob:")) for name in names)


def test_a_token_is_asked_for_and_used(browser: Page, photo: Path) -> None:
    running = Running(create_app(Predictor(FakeBackend()), "tiny", Settings(threads=1, drain=0.1, token=TOKEN)))
    try:
        browser.open(running.url)
        browser.wait(lambda: browser["token-form"].is_displayed())
        browser["token"].send_keys("a wrong one", Keys.ENTER)
        browser.wait(lambda: browser["token-form"].is_displayed() and not browser["token"].get_attribute("value"))
        browser.wait(lambda: browser["error"].text == "The service does not take this token.")
        browser["token"].send_keys(TOKEN, Keys.ENTER)
        browser.wait(lambda: "model tiny" in browser["model"].text)
        assert not browser["token-form"].is_displayed()
        assert not browser["error"].is_displayed()
        assert browser.see(photo).startswith("2 vehicles")
        # A photo chosen before there is a token is seen with it, and the model is told of too.
        browser.open(running.url)
        browser.choose(photo)
        browser.wait(lambda: browser["token-form"].is_displayed())
        browser["token"].send_keys(TOKEN, Keys.ENTER)
        browser.wait(lambda: browser["summary"].text.startswith("2 vehicles"))
        assert "model tiny" in browser["model"].text
    finally:
        assert running.stop()
