"""What a reader finds on a page of HTML."""

from html.parser import HTMLParser

from pgo_models.plots.style import plotly

EMPTY = {"meta", "link", "br", "input", "img", "hr"}


class Page(HTMLParser):
    """What a reader finds: texts, tables by id, tags that ask for something; fails on tags that do
    not match.
    """

    def __init__(self, text):
        super().__init__()
        self.texts = []
        self.tables = {}
        self.asked = []
        self.open_tags = []
        self.row = None
        self.table = None
        self.scripts = 0
        self.feed(text)
        self.close()
        assert self.open_tags == []

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.asked += [
            named[name] for name in ("src", "href", "srcset", "data", "action") if name in named
        ]
        self.scripts += tag == "script"
        if tag not in EMPTY:
            self.open_tags.append(tag)
        if tag == "table":
            self.table = self.tables.setdefault(named["id"], [])
        if tag == "tr":
            self.row = []
            self.table.append(self.row)
        if tag in ("td", "th"):
            self.row.append("")

    def handle_endtag(self, tag):
        assert self.open_tags.pop() == tag
        if tag == "tr":
            self.row = None

    def handle_data(self, data):
        if self.open_tags and self.open_tags[-1] not in ("script", "style"):
            self.texts.append(data)
            if self.row:
                self.row[-1] += data

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


def own_part(text):
    """The page without plotly's script."""
    return text.replace(plotly("offline").get_plotlyjs(), "")
