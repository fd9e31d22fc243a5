"""Controls of the driver page, pressed in a browser: keys, triggers and buttons of gamepads, mouse and finger."""

from __future__ import annotations

from tests.fakes.browser import Page

KEYS = {
    "up": "ArrowUp", "W": "KeyW", "down": "ArrowDown", "S": "KeyS", "space": "Space", "escape": "Escape",
    "backspace": "Backspace",
}  # fmt: skip
GAMEPAD_BUTTONS = {
    "right trigger": (0, 7), "left trigger": (0, 6), "other gamepad's left trigger": (1, 6),
    "button B": (0, 1), "other gamepad's button B": (1, 1),
}  # fmt: skip
"""Index of the gamepad and of its button, in the page's variable `buttons`."""


def hold(page: Page, control: str, down: bool) -> None:
    """Press or release a control; "mouse on stop" and "finger on stop" are on the page's button with that id."""
    if control in KEYS:
        page.do("Input.dispatchKeyEvent", type="rawKeyDown" if down else "keyUp", code=KEYS[control], key=control)
    elif control in GAMEPAD_BUTTONS:
        gamepad, number = GAMEPAD_BUTTONS[control]
        page.value(f"Object.assign(buttons[{gamepad}][{number}], {{value: {int(down)}, pressed: {int(down)} > 0}}); 0")
    else:
        device, _, button = control.partition(" on ")
        box = f"byId('{button}').getBoundingClientRect()"
        x, y = page.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        if device == "mouse":
            kind = "mousePressed" if down else "mouseReleased"
            page.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        else:
            points = [{"x": x, "y": y}] if down else []
            page.do("Input.dispatchTouchEvent", type="touchStart" if down else "touchEnd", touchPoints=points)
