"""Parsers of HTML pages and their charts."""

import re
from html.parser import HTMLParser
from xml.etree import ElementTree


class Page(HTMLParser):
    """Parse tags with attributes, and text, of a page; raise an error for unbalanced tags."""

    VOID = ("meta", "img", "br", "link", "wbr", "input", "source")

    def __init__(self, html):
        super().__init__()
        self.tags, self.text, self.open = [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def attributes(self, name):
        return [attributes[name] for _, attributes in self.tags if name in attributes]


def text_of(html):
    """Return the text of HTML with single spaces."""
    return " ".join(" ".join(Page(html.replace("<wbr/>", "")).text).split())


def svgs(html):
    """Return the charts as XML trees; malformed ones are an error."""
    return [ElementTree.fromstring(text) for text in re.findall(r'<svg viewBox="0 0 860.*?</svg>', html,
                                                                flags=re.DOTALL)]
