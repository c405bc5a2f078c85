"""The browser's own controls, as elements of NiceGUI: they are reached by Tab, spoken by screen readers and drawn by ``studio.css``."""

from collections.abc import Awaitable, Callable, Mapping

from nicegui import events
from nicegui.elements.mixins.text_element import TextElement

Handler = Callable[[], Awaitable[None]]
TextHandler = Callable[[str], Awaitable[None]]


class Tag(TextElement):
    """A plain element, with text or with other elements in it."""

    def __init__(self, name: str, classes: str = "", text: str = "", attributes: Mapping[str, object] | None = None) -> None:
        """``attributes``: as HTML has them."""
        super().__init__(tag=name, text=text)
        self.classes(classes)
        self.props.update(attributes or {})

    def set_attribute(self, name: str, value: object) -> None:
        """Change an attribute, if it is another; None takes it away."""
        if self.props.get(name) != value:
            self.props.set_optional(name, value)


def button(text: str, handler: Handler, classes: str = "", attributes: Mapping[str, object] | None = None, asks: bool = False) -> Tag:
    """A button that does one thing. ``asks``: not before the question in its attribute ``data-asks``, if there is one, is answered."""
    element = Tag("button", f"button {classes}", text, {"type": "button", **(attributes or {})})
    if asks:
        question = "event.currentTarget.dataset.asks"
        element.on("click", handler, [], js_handler=f"(event) => {{ if (!{question} || confirm({question})) emit(); }}")
    else:
        element.on("click", handler, [])
    return element


def link(text: str, address: str, classes: str = "") -> Tag:
    """A link to a page of the studio."""
    return Tag("a", classes, text, {"href": address})


def select(label: str, options: Mapping[str, str], chosen: str, handler: TextHandler) -> Tag:
    """A labelled choice among options, by their values."""
    with Tag("div", "field"):
        words = Tag("label", "label", label)
        element = Tag("select", "select", "", {"value": chosen})
        with element:
            for value, text in options.items():
                Tag("option", "", text, {"value": value})
    # Beside it, not around it: the label around a list would be read out with all that is in the list.
    words.set_attribute("for", f"c{element.id}")
    _on_value(element, "change", "event.target.value", handler)
    return element


def checkbox(label: str, handler: TextHandler, checked: bool = False) -> Tag:
    """A labelled box; the handler gets ``true`` or ``false``."""
    with Tag("label", "check"):
        element = Tag("input", "", "", {"type": "checkbox", "checked": checked})
        Tag("span", "", label)
    _on_value(element, "change", "String(event.target.checked)", handler)
    return element


def slider(label: str, handler: TextHandler) -> Tag:
    """A slider over whole numbers from 0; ``max`` and ``value`` are attributes."""
    element = Tag("input", "slider", "", {"type": "range", "min": 0, "max": 0, "value": 0, "aria-label": label})
    _on_value(element, "input", "event.target.value", handler)
    return element


def open_file(label: str, accept: str, largest: int, handler: TextHandler) -> Tag:
    """A button that asks for a file; the handler gets its text, or nothing where it is longer than ``largest``."""
    with Tag("label", "button file"):
        Tag("span", "", label)
        element = Tag("input", "", "", {"type": "file", "accept": accept})
    value = f"event.target.files[0].size > {largest} ? '' : await event.target.files[0].text()"
    # Emptied, so that the same file can be chosen once more.
    element.on(
        "change",
        lambda said: handler(_said(said)),
        js_handler=f"async (event) => {{ if (event.target.files.length) emit({value}); event.target.value = ''; }}",
    )
    return element


def _on_value(element: Tag, event: str, value: str, handler: TextHandler) -> None:
    element.on(event, lambda said: handler(_said(said)), js_handler=f"(event) => emit({value})")


def _said(said: events.GenericEventArguments) -> str:
    """What the page sent, which may be anything: only a text counts."""
    return said.args if isinstance(said.args, str) else ""
