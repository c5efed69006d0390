"""The first hour of a device in headless Chromium, on simulated cameras with flaws: login, exposure, every step of the setup, first picture,
recording. The bundle made so is compared with perfect knowledge of the device."""

import os
import subprocess
import tempfile
from pathlib import Path

from page_test import BINARY, DESK, PHONE, PICTURES, Browser, Service, check, drawn, log_in, no_complaints, record, slide, text, until

# cap, lamp, print and polarizer are scenes; the device is the same each time
SIZE, SEED = 128, 3
DEVICE = f"size={SIZE},seed={SEED},fine=3,imperfect=all"
# most that the bundle may lose against perfect knowledge, in dB, as in `calibrate --demo`
LOSS = 0.7


def look_at(browser, service, scene):
    """Sets the simulated scene of both cameras on the page."""
    source = f"{scene},{DEVICE}"
    for camera in ["guide", "raw"]:
        browser.click(f"#see-{camera}")
        browser.run("document.querySelector('#source').value = arguments[0]", source)
        browser.click("#set")
        until(f"{camera} shows {scene}", lambda: service.state()["cameras"][camera]["source"] == source)


def lamps(browser):
    return browser.run("return [...document.querySelectorAll('#lamps .bad')].map(lamp => lamp.textContent)")


def expose(browser, service):
    """Exposes shorter until no lamp is red, as a user would."""
    browser.click("#see-raw")
    until("a red lamp", lambda: "too bright" in lamps(browser))
    picture(browser, "mask-saturated")
    exposure = service.state()["cameras"]["raw"]["exposure_us"]["took"]
    while lamps(browser):
        exposure /= 2
        assert exposure > 100, f"{lamps(browser)} at {exposure} µs"
        slide(browser, "#exposure", exposure)
        browser.click("#set")
        until("the shorter exposure", lambda: service.state()["cameras"]["raw"]["exposure_us"]["took"] == exposure)
        # the lamps are those of frames with this exposure
        frames = service.state()["cameras"]["raw"]["frames"]
        until("frames", lambda: service.state()["cameras"]["raw"]["frames"] > frames + 5)
        until("their figures", lambda: f"took {exposure:g} µs" in text(browser, "#figures"))
    check("exposed shorter until no lamp is red", exposure < 10000, exposure)
    picture(browser, "mask-exposed")


def take(browser, angle=None):
    """Takes a step, or its view with the polarizer at an angle."""
    if angle is not None:
        slide(browser, "#angle", angle)
    until("Take is free", lambda: not browser.run("return document.querySelector('#take').disabled"))
    browser.click("#take")
    if angle is None:
        judged(browser)
    else:
        until(f"the view at {angle}", lambda: f" {angle}°" in text(browser, "#views"))


def judged(browser):
    until("a verdict", lambda: browser.run("return !document.querySelector('#decide').hidden"))
    drawn(browser, "#result")


def keep(browser, step):
    check(f"{step} says how good it is", "good" in text(browser, "#verdict"), text(browser, "#verdict"))
    picture(browser, step)
    browser.click("#keep")
    until(f"{step} is kept", lambda: browser.run(
        "return document.querySelector(`#steps button[data-step='${arguments[0]}']`).classList.contains('kept')", step))


def polarized(browser, service, step, scene, angles):
    for angle in angles:
        look_at(browser, service, f"{scene},polarizer={angle}")
        take(browser, angle)
    browser.click("#measure")
    judged(browser)
    keep(browser, step)


def picture(browser, name):
    """Pictures at both sizes, neither of which may be wider than the screen."""
    for kind, size in {"phone": PHONE, "desk": DESK}.items():
        browser.size(*size)
        wide = browser.run("scrollTo(0, 0); return document.documentElement.scrollWidth")
        check(f"{name} fits {size[0]} pixels", wide <= size[0], wide)
        browser.picture(f"setup-{name}-{kind}", full=True)


def wizard(browser, service):
    until("the steps", lambda: browser.run("return document.querySelectorAll('#steps button').length") == 5)
    check("the first step is shown", text(browser, "#title") == "Dark")
    browser.axe("the setup")
    look_at(browser, service, "uniform")
    until("the lamp", lambda: lamps(browser) == ["too bright"])
    browser.click("#take")
    until("what to do", lambda: "cover" in text(browser, "#verdict"))
    picture(browser, "dark-lit")
    look_at(browser, service, "dark")
    take(browser)
    keep(browser, "dark")
    until("the next step", lambda: text(browser, "#title") == "Mask")
    look_at(browser, service, "uniform,light=3,polarizer=0")
    expose(browser, service)
    polarized(browser, service, "mask", "uniform,light=3", [0, 45, 90, 135])
    look_at(browser, service, "point")
    slide(browser, "#exposure", 10000)
    browser.click("#set")
    until("the exposure before", lambda: service.state()["cameras"]["raw"]["exposure_us"]["took"] == 10000)
    take(browser)
    keep(browser, "psf")
    look_at(browser, service, "print")
    take(browser)
    browser.axe("a step with its result")
    keep(browser, "align")
    polarized(browser, service, "verify", "film", [0, 60, 120])
    until("the end", lambda: not browser.run("return document.querySelector('#finish').disabled"))
    browser.click("#finish")
    until("the live page", lambda: browser.run("return document.querySelector('#views') !== null"))
    until("live frames", lambda: (service.state()["frames"] or 0) > 20)
    drawn(browser, "#live")
    picture(browser, "live")


def score(found, truth):
    """PSNR of the angle images and of S1 and S2 in dB, as `calibrate --demo` has it: displaced as the measured PSF displaces the scene, which is
    a convention, and in the unit of the truth, since the mask was measured under a lamp of unknown brightness."""
    import numpy as np

    border = 12
    inside = truth[:, border:-border, border:-border]

    def at(right, down):
        part = found[:, border + down:found.shape[1] - border + down, border + right:found.shape[2] - border + right]
        part = part * (np.vdot(part, inside) / np.vdot(part, part))
        error = part - inside
        polarized = np.stack([error[0] - error[2], error[1] - error[3]])
        return [float(-10 * np.log10(np.mean(np.square(values)))) for values in (error, polarized)]

    reach = range(-border + 1, border)
    return max(at(right, down) for right in reach for down in reach)


def compare(folder):
    """The bundle against perfect knowledge: the same frames of the same device, solved with both."""
    try:
        import numpy as np
    except ImportError:
        return print("left out: the bundle is not compared with perfect knowledge; NumPy is not installed")

    def run(*command):
        subprocess.run([BINARY, "--json", *command], check=True, stdout=subprocess.DEVNULL)

    exact, scores = Path(folder, "exact"), []
    run("simulate", "--scene", "wedges", "--size", str(SIZE), "--seed", str(SEED), "--imperfect", "all", "--knowledge", "exact", "--out", exact)
    for bundle in [exact, Path(folder, "bench")]:
        out = Path(folder, f"result-{bundle.name}")
        run("reconstruct", "--calibration", bundle, "--raw", exact / "raw.npy", "--guide", exact / "guide.npy", "--fusion", "off",
            "--refit-psf", "off", "--out", out)
        scores.append(score(np.load(out / "angles.npy").astype(float), np.load(exact / "truth.npy").astype(float)))
    for name, known, made in zip(["angle images", "S1 and S2"], *scores):
        check(f"{name}: {made:.2f} dB with the bundle made here, {known:.2f} dB with perfect knowledge", known - made <= LOSS)


def main():
    PICTURES.mkdir(parents=True, exist_ok=True)
    os.environ["STOKESCOPE_TOKEN"] = "secret-token"
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "profile").mkdir()
        browser = Browser(Path(folder, "profile"))
        try:
            sessions = ["--sessions", str(Path(folder, "sessions")), "--record-format", "ome-tiff"]
            service = Service(folder, "--fps", "off", *sessions, scene="wedges", size=DEVICE.removeprefix("size="), calibration="bench")
            try:
                log_in(browser, service)
                wizard(browser, service)
                record(browser, service, folder, SIZE)
            finally:
                service.close()
            # the page of the setup asks once for what the live service does not have
            no_complaints(browser, "status of 401|/(calibrate|histogram|snapshot)[^/]* - .*status of (400|404|503)")
        finally:
            browser.close()
        compare(folder)
    print(f"pictures: {PICTURES}")


main()
