"""AppCasts, as a viewer of MOOS-IvP takes them apart."""

from usvlearn.live.moos.app import KEYS, AppCasts


def taken_apart(text: str) -> dict[str, list[str]]:
    """Field -> items: pairs between `!@#`, cut at the first `=`, and items between `!@`."""
    pairs = (pair.partition("=") for pair in text.split("!@#") if pair)
    return {key: [item for item in value.split("!@") if item] for key, _, value in pairs}


def test_a_viewer_finds_each_field():
    casts = AppCasts("pUSVLearn")
    casts.event("connected", 12.345)
    casts.warn("the disk is full, now=1")
    casts.warn("the disk is full, now=1")
    casts.config_warnings = ["set 3 is damaged"]
    found = taken_apart(casts.compose(7, "usv", ["State  ok", "", "a!@b", "=x"]))
    assert found == {
        "proc": ["pUSVLearn"],
        "iter": ["7"],
        "node": ["usv"],
        "messages": ["State  ok", "a! @b", "=x"],
        "config_warnings": ["set 3 is damaged"],
        "events_total": ["1"],
        "events": ["[12.35]: connected"],
        "run_warning_total": ["2"],
        "run_warnings": ["2:the disk is full, now=1"],
    }
    empty = AppCasts("pUSVLearn").compose(1, "usv", [])
    assert empty.count("!@#") == 8 and "run_warnings" not in empty


def due(*requests: str, at: float = 1.0, casts: AppCasts | None = None) -> bool:
    casts = casts or AppCasts("pUSVLearn")
    for request in requests:
        casts.ask(request, 0.0, "usv")
    return casts.due(at)


def test_only_requests_for_this_app_count():
    whole = "node=usv,app=pUSVLearn,duration=3.0,key=uMAC_1,thresh=any"
    assert due(whole) and due(whole, at=3.0) and not due(whole, at=3.1)
    assert due("node=all, app=all, duration=3, key=k, thresh=any")
    assert not due()
    assert not due(whole.replace("usv", "other", 1)) and not due(whole.replace("pUSVLearn", "pOther"))
    for nonsense in ("", "=", "node", "duration=3", whole.replace("3.0", "nan"), whole.replace("3.0", "soon")):
        assert not due(nonsense)
    assert not due(whole.replace("3.0", "1e9"), at=31.0)


def test_each_key_has_its_own_end():
    long, short = "node=usv,app=all,duration=20,key=a,thresh=any", "node=usv,app=all,duration=1,key=b,thresh=any"
    assert due(long, short, at=10.0) and not due(long, short.replace("key=b", "key=a"), at=10.0)
    casts = AppCasts("pUSVLearn")
    for k in range(10 * KEYS):
        casts.ask(f"node=usv,app=all,duration=20,key={k}", 0.0, "usv")
    assert len(casts._asked) == KEYS


def test_a_viewer_may_wait_for_warnings():
    casts = AppCasts("pUSVLearn")
    assert not due("node=usv,app=all,duration=20,key=a,thresh=run_warning", casts=casts)
    casts.warn("trouble")
    assert casts.due(2.0) and not casts.due(3.0)
    casts.warn("trouble")
    assert casts.due(4.0)
    for k in range(10 * KEYS):
        casts.warn(f"{k}")
    assert len(casts.warnings) == KEYS and f"{10 * KEYS - 1}" in casts.warnings
