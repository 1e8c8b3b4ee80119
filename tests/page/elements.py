"""Parts of the page, as tests find them."""

from playwright.sync_api import Locator, Page, expect


def tile(page: Page, robot: int) -> Locator:
    return page.locator(f"[data-robot='{robot}']")


def answer(page: Page, name: str) -> None:
    """Answer the page's open question."""
    page.get_by_role("alertdialog").get_by_role("button", name=name, exact=True).click()


def in_mode(page: Page, mode: str) -> None:
    for robot in (1, 2):
        expect(tile(page, robot)).to_have_attribute("data-mode", mode)


def button(page: Page, name: str) -> Locator:
    return page.get_by_role("button", name=name, exact=True)


def map_of(page: Page, length_m: float, width_m: float) -> tuple[tuple[float, float], float]:
    """The pool's middle on the screen, and pixels per metre, as long as nobody has zoomed."""
    canvas = page.locator(".pool canvas").bounding_box()
    assert canvas is not None
    scale = min((canvas["width"] - 56) / length_m, (canvas["height"] - 56) / width_m)
    return (canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2), scale
