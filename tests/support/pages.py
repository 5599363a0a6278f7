"""What a page says first."""

import re


def first_words(page: str) -> list[str]:
    """Return the headline of a page and, if there is more of the answer, the paragraph below."""
    match = re.search(r'<p class="answer">(.*?)</p>\n(?:<p>((?!Conditions).*?)</p>)?', page)
    assert match is not None
    return [text for text in match.groups() if text]
