r"""Formulas of the docstrings, which are plain text there, as TeX for the site.

    ||R_j - R_i R_ij||_F^2 <= 1 becomes \lVert R_{j} - R_{i} R_{ij} \rVert_{F}^{2} \le 1

A formula is read from left to right as a sequence of operands, operators and brackets; what cannot
be read is no formula and stays as it is written. `display` takes the lines of an indented block, in
which words may stand between formulas. `inline` looks for formulas in prose, where only what no
sentence contains is taken for one: indices, powers, norms, Greek letters, equations, and single
letters other than a, A and I.
"""

import re
from dataclasses import dataclass

SMALL_GREEK = ("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "kappa")
SMALL_GREEK += ("lambda", "mu", "nu", "xi", "pi", "rho", "sigma", "tau", "phi", "chi", "psi")
SMALL_GREEK += ("omega",)
LARGE_GREEK = ("Gamma", "Delta", "Theta", "Lambda", "Xi", "Pi", "Sigma", "Phi", "Psi", "Omega")
GREEK = (*SMALL_GREEK, *LARGE_GREEK)
NAMES_OF_TEX = (*GREEK, "cos", "sin", "log", "exp", "det", "min", "max")
TEX_NAMES = {name: f"\\{name}" for name in NAMES_OF_TEX}
TEX_NAMES |= {"sum": "\\sum", "epsilon": "\\varepsilon", "lam": "\\lambda", "dn": "dn"}
OPERATORS = ("argmin", "argmax", "tr", "diag", "blockdiag", "rank", "vec", "vee", "sign", "sym")
OPERATORS += ("skew", "SO", "St", "Exp", "Log", "prox")
TEX_NAMES |= {name: f"\\operatorname{{{name}}}" for name in OPERATORS}
# These stand before an operand. In prose they are also words: "the sum of", "log files".
FUNCTIONS = {*OPERATORS, "cos", "sin", "log", "exp", "det", "min", "max", "sum", "sqrt", "hat"}
ARTICLES = ("a", "A", "I")
SIDES = ("d", "m", "n", "p", "r")  # numbers of rows and columns, as in "d x d"
INDICES = ("i", "j", "k", *SIDES)
# Before one of these words "sum", "min" and "log" are words.
DETERMINERS = ("the", "a", "an", "its", "this", "their", "every", "robot", "of")

RELATIONS = {"=": "=", "<": "<", ">": ">", "<=": "\\le", ">=": "\\ge", "!=": "\\ne"}
RELATIONS |= {"<-": "\\leftarrow", "->": "\\to", "+=": "\\mathrel{+}=", "-=": "\\mathrel{-}="}
BINARY = {"+": "+", "-": "-", "*": "\\cdot", "/": "/"}
BRACKETS = {"(": ")", "[": "]", "{": "}"}
TEX_BRACKETS = {"(": ("(", ")"), "[": ("[", "]"), "{": ("\\{", "\\}")}
BARS = {"||": ("\\lVert", "\\rVert"), "|": ("\\lvert", "\\rvert")}

TOKEN = re.compile(
    r"(?P<number>\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![A-Za-z]))"
    r"|(?P<name>[A-Za-z]+(?:'[a-z]+)?(?![\d]))"
    r"|(?P<sign><=|>=|!=|<-|->|[+-]=|\|\||\.{2,3}|[-+*/=<>|^_'(){}\[\],;:.])"
    r"|(?P<other>\S)"
)
# A sentence may go on like this behind a formula, but not with a letter, a hyphen or "=".
AFTER = re.compile(r"$|\s|[.,;:!?)\]}'\"]+(?:$|[\s)\]])")
# Behind "F.", these words begin a sentence, and "F" is no initial of a name.
SENTENCE_STARTS = {"The", "This", "It", "Its", "If", "In", "For", "Where", "With", "They", "These"}
SENTENCE_STARTS |= {"A", "An", "As", "At", "Both", "By", "Each", "Here", "No", "On", "Only", "So"}
SENTENCE_STARTS |= {"That", "Then", "There", "Those", "To", "What", "When", *LARGE_GREEK}


class NoFormulaError(Exception):
    """The text is no formula that can be read."""


@dataclass(frozen=True)
class Token:
    """A number, a name or a sign, with its place in the text and the blanks before it."""

    kind: str
    text: str
    start: int
    blanks: int

    @property
    def end(self) -> int:
        """Place behind the token."""
        return self.start + len(self.text)


END = Token("end", "", -1, 1)


def tokens_of(text: str) -> list[Token]:
    """Return the tokens of a text."""
    tokens: list[Token] = []
    for match in TOKEN.finditer(text):
        before = tokens[-1].end if tokens else 0
        tokens.append(Token(str(match.lastgroup), match[0], match.start(), match.start() - before))
    return tokens


@dataclass
class Reader:
    """Reads tokens from a position on, and writes TeX.

    `has_words`: words are text between formulas, and operators may stand at the ends; otherwise a
    word ends the formula. `marks` collects what was seen, by which prose and formulas differ.
    """

    tokens: list[Token]
    has_words: bool
    position: int = 0
    depth: int = 0

    def __post_init__(self) -> None:
        self.marks: set[str] = set()

    def next(self, ahead: int = 0) -> Token:
        """Return the next token, or the one so many behind it."""
        place = self.position + ahead
        return self.tokens[place] if place < len(self.tokens) else END

    def is_next(self, text: str) -> bool:
        """Return whether the next token is this sign, with no blank before it."""
        return self.next().text == text and self.next().blanks == 0

    def sequence(self, closer: str = "") -> list[str]:
        """Read operands and operators up to the closer, the end, or what is no formula."""
        parts: list[str] = []
        complete = (self.position, 0)  # behind the last operand: position, and number of parts
        while self.next() is not END and not self.closes(closer):
            try:
                part, is_operand = self.part(follows=bool(parts))
            except NoFormulaError:
                if self.has_words or closer:
                    raise
                break
            parts.append(part)
            if is_operand:
                complete = (self.position, len(parts))
        if not self.has_words and not closer:
            self.position, count = complete
            return parts[:count]
        return parts

    def closes(self, closer: str) -> bool:
        """Return whether the next token is the closer; an angle closes right behind its operand."""
        return self.next().text == closer and (closer != ">" or self.next().blanks == 0)

    def part(self, follows: bool) -> tuple[str, bool]:
        """Read an operand or an operator, and say whether it was an operand."""
        start = self.position
        try:
            return self.any_part(follows)
        except NoFormulaError:
            self.position = start
            raise

    def any_part(self, follows: bool) -> tuple[str, bool]:
        """Read an operand or an operator; where that fails the position may have moved."""
        token = self.next()
        gap = self.gap(token) if follows else ""
        if self.opens_angle(token):
            return gap + self.scripted(self.angle()), True
        if token.text in RELATIONS or token.text in BINARY:
            return gap + self.operator(token, follows), False
        if token.text in (",", ";", ":", ".", "..", "..."):
            return gap + self.punctuation(token), False
        return gap + self.operand(token, follows), True

    def gap(self, token: Token) -> str:
        """Return the distance of what stands apart in a line."""
        if token.blanks < 2 or token.text in RELATIONS or token.text in BINARY:
            return ""
        if self.depth or not self.has_words:
            raise NoFormulaError("blanks")
        return "\\qquad "

    def operator(self, token: Token, follows: bool) -> str:
        """Read a relation or a binary operator, which has blanks on both sides, or on none."""
        behind = self.next(1)
        if token.text == "-" and behind.blanks == 0 and not (follows and self.is_after_operand()):
            self.position += 1
            return "-"
        if not self.has_words:
            is_apart = token.blanks > 0
            is_bound = not is_apart and token.text != "/" and not self.depth
            if not follows or is_bound or is_apart != (behind.blanks > 0):
                raise NoFormulaError(token.text)
        self.position += 1
        if token.text in RELATIONS:
            self.marks.add("relation")
            return RELATIONS[token.text]
        self.marks.add("operator")
        return BINARY[token.text]

    def is_after_operand(self) -> bool:
        """Return whether the token before is no operator, relation or comma."""
        return self.tokens[self.position - 1].text not in (*BINARY, *RELATIONS, ",", ";")

    def punctuation(self, token: Token) -> str:
        """Read a comma, a colon, a period or dots."""
        if not self.has_words and not (self.depth and token.text in (",", ";")):
            raise NoFormulaError(token.text)
        self.position += 1
        if token.text in ("..", "..."):
            return "\\ldots"
        is_apart = self.next() is not END and self.next().blanks == 1 and not self.depth
        return token.text + ("\\ " if is_apart else "")

    def operand(self, token: Token, follows: bool) -> str:
        """Read a number, a name or a bracket, with its indices and powers."""
        if token.kind == "number":
            if not self.has_words and follows and self.is_after_operand():
                raise NoFormulaError("a number is written before its factor")
            self.position += 1
            return self.scripted(number(token.text))
        if token.kind == "name":
            return self.name(token, follows)
        if token.text in BARS:
            return self.bars(token)
        if token.text in BRACKETS:
            return self.bracket(token, follows)
        raise NoFormulaError(token.text)

    def name(self, token: Token, follows: bool) -> str:
        """Read a letter, a Greek letter, a function, or words."""
        name = token.text
        if name in ("sqrt", "hat") and self.next(1).text == "(":
            self.position += 1
            return self.root_or_hat(name)
        if name in FUNCTIONS:
            return self.function(token, follows)
        if name == "x" and follows and self.is_between_operands():
            return self.times()
        if len(name) == 1 or name in TEX_NAMES:
            return self.letter(token, follows)
        return self.words(follows)

    def letter(self, token: Token, follows: bool) -> str:
        """Read a letter or a Greek letter, unless it is a word."""
        name = token.text
        behind = self.next(1)
        if name in ARTICLES and not self.is_letter_here(follows):
            if self.has_words and name == "a":
                return self.words(follows)
            if follows or name == "a" or not is_within_sentence(self.tokens, self.position):
                raise NoFormulaError(name)
        self.position += 1
        if len(name) > 1:
            self.marks.add("Greek")
        if behind.text == "(" and behind.blanks == 0:
            self.marks.add("function")
        return self.scripted(TEX_NAMES.get(name, name))

    def is_letter_here(self, follows: bool) -> bool:
        """Return whether "a", "A" or "I" is a letter of a formula here, and not a word."""
        behind = self.next(1)
        if behind.blanks == 0 and behind.text in ("_", "^", "(", ")", "'", "|", "||", ","):
            return True
        if self.next().text != "a" and (self.depth or (follows and self.has_words)):
            return True
        if behind.text == self.next().text and self.next(2).text == "^":  # a a^T
            return True
        signs = ("+", "-", "/", *RELATIONS)
        third = self.next(2)
        is_factor = third.text in signs or (follows and third.kind != "name")
        if is_factor and len(behind.text) == 1 and behind.kind == "name":
            return True  # A x = b, or r^T I r
        before = self.tokens[self.position - 1].text if follows else ""
        return behind.text in signs or before in signs

    def is_between_operands(self) -> bool:
        """Return whether the next token stands between operands, with blanks around it."""
        behind = self.next(1)
        is_operand = behind.kind == "number" or (behind.kind == "name" and len(behind.text) == 1)
        return is_operand and behind.blanks == 1 and self.is_after_operand()

    def times(self) -> str:
        """Read the sign of "d x d"; "w x v" may be a vector product or one of three factors."""
        sides = (self.tokens[self.position - 1], self.next(1))
        if not all(side.kind == "number" or side.text in SIDES for side in sides):
            raise NoFormulaError("x")
        self.position += 1
        self.marks.add("operator")
        return "\\times " + self.operand(self.next(), follows=False)

    def function(self, token: Token, follows: bool) -> str:
        """Read the name of a function, which an operand follows; else it is a word."""
        behind = self.next(1)
        is_word = behind.kind == "name" and not is_symbol(behind.text)
        if is_word and self.has_words and token.text not in ("min", "max", "argmin"):
            return self.words(follows)
        is_joined = behind.blanks == 0 and behind.text in ("(", "_")
        if not self.has_words and not is_joined and self.is_word_of_prose(token, follows):
            raise NoFormulaError(token.text)
        self.position += 1
        if is_joined:
            self.marks.add("function")
        tex = self.scripted(TEX_NAMES[token.text])
        if self.has_words:
            return tex
        return f"{tex} {self.operand(self.next(), follows=False)}"

    def is_word_of_prose(self, token: Token, follows: bool) -> bool:
        """Return whether "sum", "log" or the like is a word: "the sum F", "a log (JRL)"."""
        behind = self.next(1)
        if behind.text == "(" or behind.text == token.text:
            return True
        return not follows and self.tokens[self.position - 1].text in DETERMINERS

    def root_or_hat(self, name: str) -> str:
        """Read the bracket of sqrt(..) or hat(..)."""
        inner = self.inside("(")
        self.marks.add("function")
        accent = "\\hat" if re.fullmatch(r"\\?\w+", inner) else "\\widehat"
        return self.scripted(f"\\sqrt{{{inner}}}" if name == "sqrt" else f"{accent}{{{inner}}}")

    def words(self, follows: bool) -> str:
        """Read words up to the next operand, or an identifier, or the name of a function."""
        first, behind = self.next(), self.next(1)
        if not self.has_words or re.search("[a-z][A-Z]", first.text):
            raise NoFormulaError(first.text)
        if behind.text == "_" and behind.blanks == 0:
            return self.identifier()
        if behind.text == "(" and behind.blanks == 0:
            self.position += 1
            return self.scripted(f"\\operatorname{{{first.text}}}")
        text = ""
        while self.is_word(text):
            text += " " * min(1, self.next().blanks) + self.next().text
            self.position += 1
        if not text:
            raise NoFormulaError(first.text)
        self.marks.add("word")
        text = (" " if follows and first.blanks else "") + text.strip()
        is_apart = self.next().blanks == 1 and self.next() is not END
        return f"\\text{{{text}{' ' if is_apart else ''}}}"

    def is_word(self, text: str) -> bool:
        """Return whether the next token goes on with a text that has begun, or begins it."""
        token, behind = self.next(), self.next(1)
        if text and token.blanks > 1:
            return False
        if token.text == "-" and text:
            return token.blanks == 0 and behind.kind == "name" and behind.blanks == 0
        if token.kind != "name" or (behind.blanks == 0 and behind.text in ("_", "^", "(")):
            return False
        if token.text == "a":
            return behind.kind == "name" and not is_symbol(behind.text)
        is_sum = token.text == "sum" and behind.text in ("of", "over")
        return is_sum or not is_symbol(token.text)

    def identifier(self) -> str:
        """Read a name of the code, such as relative_error."""
        text = self.next().text
        self.position += 1
        if re.fullmatch("[a-z]{2}", text) and len(self.next(1).text) == 1:  # dg_k
            return self.scripted(f"\\mathit{{{text}}}")
        while self.is_next("_") and self.next(1).kind == "name":
            text += "\\_" + self.next(1).text
            self.position += 2
        behind = self.next()
        is_factor = behind.blanks == 1 and (behind.kind == "name" or behind.text in BARS)
        return self.scripted(f"\\mathtt{{{text}}}") + ("\\," if is_factor else "")

    def bars(self, token: Token) -> str:
        """Read a norm or an absolute value."""
        self.position += 1
        inner = self.nested(token.text)
        self.marks.add("norm")
        left, right = BARS[token.text]
        return self.scripted(f"{left} {inner} {right}")

    def opens_angle(self, token: Token) -> bool:
        """Return whether the token opens an inner product: <p, x>, as against p < x."""
        return token.text == "<" and self.next(1).blanks == 0 and self.next(1).kind == "name"

    def angle(self) -> str:
        """Read an inner product."""
        self.position += 1
        inner = self.nested(">")
        self.marks.add("norm")
        return f"\\langle {inner} \\rangle"

    def bracket(self, token: Token, follows: bool) -> str:
        """Read a bracket, which is a matrix if it has semicolons."""
        if not self.has_words and follows and token.blanks and self.next(2).text in (")", "]"):
            raise NoFormulaError("the number of an equation, or a step")
        rows = self.rows_of_matrix(token.text)
        if rows:
            return self.scripted(rows)
        left, right = TEX_BRACKETS[token.text]
        return self.scripted(f"{left}{self.inside(token.text)}{right}")

    def inside(self, opening: str) -> str:
        """Read a bracket, and return what is inside."""
        if self.next().text != opening:
            raise NoFormulaError(opening)
        self.position += 1
        return self.nested(BRACKETS[opening])

    def nested(self, closer: str) -> str:
        """Read up to the closer, and the closer."""
        self.depth += 1
        parts = self.sequence(closer)
        self.depth -= 1
        if not parts or not self.closes(closer):
            raise NoFormulaError(closer)
        self.position += 1
        return " ".join(parts)

    def rows_of_matrix(self, opening: str) -> str:
        """Return a matrix such as [A, B; C, D], or nothing if the bracket is not one."""
        depth = 0
        rows: list[list[list[Token]]] = [[[]]]
        for place in range(self.position, len(self.tokens)):
            token = self.tokens[place]
            depth += (token.text in BRACKETS) - (token.text in BRACKETS.values())
            if depth == 0:
                break
            if depth == 1 and token.text == ";":
                rows.append([[]])
            elif depth == 1 and token.text == ",":
                rows[-1].append([])
            elif place > self.position:
                rows[-1][-1].append(token)
        if depth or len(rows) == 1:
            return ""
        if len({len(row) for row in rows}) > 1 or not self.has_words:
            raise NoFormulaError("matrix")
        self.position = place + 1
        body = " \\\\ ".join(" & ".join(map(self.entry, row)) for row in rows)
        kind = "bmatrix" if opening == "[" else "pmatrix"
        return f"\\begin{{{kind}}} {body} \\end{{{kind}}}"

    def entry(self, tokens: list[Token]) -> str:
        """Return an entry of a matrix; a period stands for the transpose of the opposite one."""
        if [token.text for token in tokens] == ["."]:
            return "\\cdot"
        return " ".join(Reader(tokens, has_words=True, depth=1).sequence())

    def scripted(self, base: str) -> str:
        """Read the primes, indices and powers behind an operand."""
        below, above, primes = "", "", ""
        while self.next().blanks == 0 and self.next().text in ("'", "_", "^", "*"):
            sign = self.next().text
            if sign == "*" and not self.is_star():
                break
            self.position += 1
            if sign in ("'", "*"):
                primes += "\\prime " if sign == "'" else "* "
            elif sign == "_":
                if below:
                    raise NoFormulaError("two indices")
                below = self.index()
            elif self.is_hat():
                base = f"\\hat{{{base}}}"
            else:
                if above:
                    raise NoFormulaError("two powers")
                above = self.power()
            self.marks.add("script")
        above = (primes + above).strip()
        return base + (f"_{{{below}}}" if below else "") + (f"^{{{above}}}" if above else "")

    def is_hat(self) -> bool:
        """Return whether a circumflex is an accent: nothing stands directly behind it."""
        behind = self.next()
        starts = behind.kind in ("name", "number") or behind.text in ("-", "+", "*", "{", "(")
        return behind.blanks > 0 or not starts

    def is_star(self) -> bool:
        """Return whether an asterisk marks an operand, such as Z*, and is no product."""
        behind = self.next(1)
        return behind.blanks > 0 or behind.kind not in ("name", "number")

    def index(self) -> str:
        """Read an index: letters, a number, a sign, or a bracket."""
        token = self.next()
        if token.blanks or token is END:
            raise NoFormulaError("_")
        if token.text in ("{", "("):
            return self.inside(token.text)
        if token.text != "+" and token.kind not in ("name", "number"):
            raise NoFormulaError("_")
        self.position += 1
        index = script_name(token.text)
        second = self.next(1)
        if self.is_next(",") and second.blanks == 0 and re.fullmatch("[a-z]", second.text):
            self.position += 2
            index += "," + second.text
        return index

    def power(self) -> str:
        """Read a power: letters, a number or a fraction with its sign, or a bracket."""
        token = self.next()
        if token.text in ("{", "("):
            return self.inside(token.text)
        self.position += 1
        if token.text == "-":
            exponent = self.next()
            if exponent.blanks or exponent.kind not in ("name", "number"):
                raise NoFormulaError("^-")
            self.position += 1
            return "-" + script_name(exponent.text) + self.half(exponent)
        return script_name(token.text) + self.half(token)

    def half(self, numerator: Token) -> str:
        """Read the end of a power such as s^1/2; r^2/2 is half of a square."""
        behind = self.next(1)
        if numerator.text not in ("1", "3") or not self.is_next("/") or behind.blanks:
            return ""
        if behind.kind != "number":
            return ""
        self.position += 2
        return "/" + behind.text


def is_within_sentence(tokens: list[Token], place: int) -> bool:
    """Return whether a word in small letters stands before: then "A" is no article."""
    before = tokens[place - 1] if place else END
    return before.kind == "name" and before.text.islower()


def is_symbol(name: str) -> bool:
    """Return whether a name is a letter or has a meaning in formulas."""
    return len(name) == 1 or name in TEX_NAMES or name in FUNCTIONS


def script_name(text: str) -> str:
    """Return an index or a power; one of three and more letters is a word."""
    if text in GREEK or text in ("min", "max"):
        return TEX_NAMES[text]
    return f"\\mathrm{{{text}}}" if text.isalpha() and len(text) > 2 else text


def number(text: str) -> str:
    """Return a number; 1e-6 becomes a power of ten."""
    digits, _, exponent = text.partition("e")
    if not exponent:
        return digits
    power = f"10^{{{int(exponent)}}}"
    return power if digits == "1" else f"{digits} \\cdot {power}"


def display(lines: list[str]) -> str | None:
    """Return the lines of an indented block as TeX, or None if it is no formula."""
    indent = min(len(line) - len(line.lstrip()) for line in lines)
    rows = []
    marks: set[str] = set()
    for line in lines:
        text = line[indent:].rstrip()
        reader = Reader(tokens_of(text.strip()), has_words=True)
        if any(token.kind == "other" for token in reader.tokens) or is_table_row(text):
            return None
        try:
            parts = reader.sequence()
        except NoFormulaError:
            return None
        if reader.position < len(reader.tokens):
            return None
        is_inset = len(text) > len(text.lstrip())
        if is_inset and reader.tokens[0].text not in (*BINARY, *RELATIONS) and has_gap(rows):
            return None  # an entry of a table that goes on below itself
        rows.append(("\\quad " if is_inset else "") + " ".join(parts))
        marks |= reader.marks
    if not marks & {"script", "norm"} or not marks & {"relation", "operator", "function"}:
        return None
    return aligned(rows)


def has_gap(rows: list[str]) -> bool:
    """Return whether something stands apart in one of these rows of TeX."""
    return any("\\qquad " in row for row in rows)


def is_table_row(text: str) -> bool:
    """Return whether a line names several of its entries: "t_i: tau   R_i: tau t_ij^T"."""
    return len(re.findall(r"\w:\s", text)) > 1


def aligned(rows: list[str]) -> str:
    """Return rows of TeX below each other, in columns if all have the same number of them."""
    if len(rows) == 1:
        return rows[0]
    columns = [row.split("\\qquad ") for row in rows]
    counts = {len(row) for row in columns}
    if len(counts) == 1 and counts != {1}:
        cells = [[f"\\displaystyle {cell.strip()}" for cell in row] for row in columns]
        body = " \\\\ ".join(" & ".join(row) for row in cells)
        layout = "@{\\qquad}".join("l" * len(cells[0]))
        return f"\\begin{{array}}{{{layout}}} {body} \\end{{array}}"
    body = " \\\\ ".join("& " + row for row in rows)
    return f"\\begin{{aligned}} {body} \\end{{aligned}}"


def inline(text: str) -> list[tuple[str, bool]]:
    """Split prose into text and formulas, as TeX; a pair says which is a formula."""
    tokens = tokens_of(text)
    pieces: list[tuple[str, bool]] = []
    done = 0
    k = 0
    while k < len(tokens):
        found = formula_at(text, tokens, k)
        if found is None:
            k += 1
            continue
        tex, last = found
        if tex:
            pieces += [(text[done : tokens[k].start], False), (tex, True)]
            done = tokens[last].end
        k = last + 1
    return [*pieces, (text[done:], False)]


def formula_at(text: str, tokens: list[Token], first: int) -> tuple[str, int] | None:
    """Return the formula that begins with a token, and its last token, or None.

    Letters beside each other that may be words or coordinates, such as "x y z", are no formula.
    """
    token = tokens[first]
    if token.start and text[token.start - 1] not in " ([":
        return None
    if token.kind == "name" and len(token.text) > 1 and not is_symbol(token.text):
        return None
    reader = Reader(tokens, has_words=False, position=first)
    try:
        parts = reader.sequence()
    except NoFormulaError:
        return None
    last = reader.position - 1
    if not parts or not AFTER.match(text, tokens[last].end):
        return None
    is_one = is_formula(tokens, first, last, reader.marks)
    return (" ".join(parts) if is_one else ""), last


def is_formula(tokens: list[Token], first: int, last: int, marks: set[str]) -> bool:
    """Return whether what was read as a formula is one, and not a word, a unit or a list."""
    names = [token for token in tokens[first : last + 1] if token.kind == "name"]
    if not names:
        return False
    if marks & {"script", "norm", "function", "Greek", "relation", "operator"}:
        return True
    is_tuple = tokens[first].text in BRACKETS and last > first + 2
    if is_tuple:
        return tokens[first].text == "(" and any(t.text == "," for t in tokens[first:last])
    if first < last:
        if tokens[first].kind == "number" and tokens[last].text not in ("d", "n"):
            return False  # 2.6 m
        return all(name.text.isupper() or name.text in INDICES for name in names)
    return is_lone_letter(tokens, first)


def is_lone_letter(tokens: list[Token], place: int) -> bool:
    """Return whether a single letter in prose is one of a formula: no unit, step or initial."""
    token = tokens[place]
    before = tokens[place - 1] if place else END
    if token.text in ARTICLES and (token.text == "a" or not is_within_sentence(tokens, place)):
        return False
    behind = tokens[place + 1] if place + 1 < len(tokens) else END
    if before.kind == "number" or behind.kind == "number":
        return False
    if "x" in (token.text, before.text, behind.text):
        return False
    if before.text in BRACKETS and behind.text in BRACKETS.values():
        return False
    if before.text in (*BINARY, *RELATIONS) or behind.text in (*BINARY, *RELATIONS):
        return False
    if behind.text == ".":
        follower = tokens[place + 2] if place + 2 < len(tokens) else END
        return follower is END or follower.text in SENTENCE_STARTS
    return True
