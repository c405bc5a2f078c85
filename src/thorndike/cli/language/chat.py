"""``thorndike language chat MODEL``: a conversation in the terminal, written out while it is made."""

import sys
from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.language.arguments import add_model_argument, add_sampling_arguments, prepare_device
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.parser import Parser, seed_number

EXAMPLES = """\
  thorndike language chat MODEL
  thorndike language chat MODEL --temperature 0.7 --top-p 0.9 --system "Answer in one sentence."
An empty line, or Ctrl-D, ends it. A model without a chat template goes on with what is typed."""


def run(words: Sequence[str]) -> Answer:
    """Read lines, and answer each."""
    parser = Parser("language chat", "Talk with a model.", EXAMPLES)
    add_model_argument(parser)
    add_sampling_arguments(parser, 256)
    parser.add_argument("--system", metavar="TEXT", help="what the model is told before the conversation")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number that all answers follow from (default: 0)")
    options = parse_with_config(parser, words, "chat", None)
    options.model = model_folder(options.model)
    prepare_device(options.device, options.model)
    from thorndike.language.generation import Sampling, stream_text
    from thorndike.language.model import load_model

    model = load_model(options.model, adapter=options.adapter)
    sampling = Sampling(options.temperature, options.top_k, options.top_p)
    messages: list[dict[str, object]] = [] if options.system is None else [{"role": "system", "content": options.system}]
    turns = 0
    while said := _line():
        messages.append({"role": "user", "content": said})
        prompt = model.tokenizer.encode(said) if model.tokenizer.template is None else model.tokenizer.encode_chat(messages)
        answer = ""
        for piece in stream_text(model, prompt, max_new_tokens=options.max_new_tokens, sampling=sampling, seed=options.seed + turns):
            answer += piece
            print(piece, end="", flush=True)
        print()
        messages.append({"role": "assistant", "content": answer})
        turns += 1
    return Answer({"model": options.model, "turns": turns, "messages": messages}, "")


def _line() -> str:
    """What is typed next; empty at the end."""
    if sys.stdin.isatty():
        print("> ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().rstrip("\n")
