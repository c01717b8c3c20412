"""XML with the rules of TinyXML 2."""

from __future__ import annotations

from xml.etree.ElementTree import tostring

import pytest

from rover_rl.tiny_xml import parse_xml

READ = {
    "space before the declaration": ("\n  <?xml version='1.0'?><a/>", "<a />"),
    "a byte order mark": ("\ufeff<?xml version='1.0'?><a/>", "<a />"),
    "a comment before the declaration": ("<!-- x --><?xml version='1.0'?><a/>", "<a />"),
    "another encoding than it says": ("<?xml version='1.0' encoding='UTF-16'?><a>é</a>", "<a>&#233;</a>"),
    "an unknown encoding": ("<?xml version='1.0' encoding='ours'?><a/>", "<a />"),
    "dashes in a comment": ("<a><!-- ---- <b> -- ---></a>", "<a />"),
    "undeclared prefixes": ("<a><gz:b gz:c='1'/></a>", '<a><gz:b gz:c="1" /></a>'),
    "entities of XML": ("<a b='&lt;&#65;'>&amp;&#x42;</a>", '<a b="&lt;A">&amp;B</a>'),
    "entities of no one": ("<a b='x?c&d=&no;'>R&D &#xFFFFFFFFFF;</a>", None),
    "less than in an attribute": ("<a b='1<2' c=\"'\"/>", None),
    "attributes without space": ("<a b='1'c='2' d = '3'\n/>", '<a b="1" c="2" d="3" />'),
    "CDATA": ("<a>1<![CDATA[ <2> & ]]>3</a>", "<a>1 &lt;2&gt; &amp; 3</a>"),
    "a document type": ("<!DOCTYPE a SYSTEM 'a.dtd'><a/>", "<a />"),
    "text, comments and elements after the root": ("<a/><!-- x -->\n<b/>", "<a />"),
    "text around elements": ("<a> 1 <b>2</b>\n3 <!-- x -->4</a>", "<a> 1 <b>2</b>\n3 4</a>"),
}


@pytest.mark.parametrize(("text", "expected"), READ.values(), ids=READ)
def test_what_tinyxml_reads_is_read(text, expected):
    root = parse_xml(text.encode())
    if expected is not None:
        assert tostring(root).decode() == expected
    elif root.text:
        assert (root.get("b"), root.text) == ("x?c&d=&no;", "R&D &#xFFFFFFFFFF;")
    else:
        assert root.attrib == {"b": "1<2", "c": "'"}


def test_bytes_of_another_encoding_are_read():
    assert parse_xml("<a b='Büro'>1</a>".encode("latin-1")).attrib == {"b": "Büro"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no element found: line 1"),
        ("words\n", "no element found: line 2"),
        ("<a>\n<b></b>", "no element found that ends <a>: line 2"),
        ("<a><b></a>", "</a> ends no <a>"),
        ("<a></b>", "</b> ends no <b>"),
        ("</a>", "</a> ends no <a>"),
        ("<a b='1' b='1'/>", "duplicate attribute 'b'"),
        ("<a b=1/>", "the tag <a> is damaged"),
        ("<a b='1", "the tag <a> is damaged"),
        ("<a><!-- x</a>", "no tag, comment or text"),
        ("<1/>", "no tag, comment or text"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "declares XML entities"),
    ],
)
def test_the_rest_is_refused_in_one_sentence(text, message):
    with pytest.raises(ValueError, match=message) as error:
        parse_xml(text.encode())
    assert "\n" not in str(error.value)
