"""Files of others: plain data is read, code is not run, paths and links do not lead elsewhere."""

import pytest
import yaml

from sb3_tdpg.common.trust import PlainLoader, check_plain, plain_name, say_what_is_trusted

PLAIN = ["20", "1/75", "-1.5e-3", "float('inf')", "dict(trv_dim=3, net_arch=dict(encoder=[8, 8]))", "['a', ('b',)]",
         "{'a': None}", "dict(activation_fn=nn.ReLU)", "True", "'text'"]  # fmt: skip
CODE = ["__import__('os').system('true')", "[].__class__", "(lambda: 3)()", "open('x')", "nn.modules.sys", "th.load",
        "nn.__dict__", "nn.ReLU()", "[x for x in ()]", "f'{open}'", "2 **9**9", "a", "1 +", "(" * 500]  # fmt: skip


@pytest.mark.parametrize("text", PLAIN)
def test_plain_data_in_pythons_notation_is_let_through(text):
    check_plain(text, "here:")


@pytest.mark.parametrize("text", CODE, ids=range(len(CODE)))
def test_text_that_would_run_or_name_anything_is_refused(text):
    with pytest.raises(ValueError, match=r"here: .*which is not plain data and is not evaluated"):
        check_plain(text, "here:")


def test_what_the_zoo_writes_is_read():
    text = (
        "!!python/object/apply:collections.OrderedDict\n- - - a\n    - !!python/tuple\n      - 1\n      - b\n"
        "  - - normalize\n    - \"dict(norm_obs=True)\"\n"
    )  # fmt: skip
    assert yaml.load(text, PlainLoader) == {"a": (1, "b"), "normalize": "dict(norm_obs=True)"}


@pytest.mark.parametrize("text", [
    "3", "[]", "", "{a: ", "!!python/object/apply:collections.OrderedDict []", "!!python/object/apply:os.getcwd []",
    "a: !!python/name:os.system", "normalize: open('x')",
])  # fmt: skip
def test_anything_else_is_refused_in_a_line(text):
    with pytest.raises(ValueError, match="not plain data") as refused:
        yaml.load(text, PlainLoader)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["../evil", "/etc", "a/b", "..", ".", "", "C:a", "a\\b", 3, None])
def test_a_path_is_not_the_name_of_a_folder(name):
    assert plain_name("pg-seed0", "start") == "pg-seed0"
    with pytest.raises(ValueError, match=r"start is .*without a path"):
        plain_name(name, "start")


def test_three_files_are_named_and_the_others_counted(capsys):
    say_what_is_trusted()
    assert capsys.readouterr().out == ""
    say_what_is_trusted(*"abcde")
    assert capsys.readouterr().out.startswith("trusting whoever wrote a, b, c and 2 more: ")
