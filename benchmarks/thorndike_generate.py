"""Thorndike's ``generate`` on a folder's model: tokens per second and per CPU-second; a line for ``language_speed.py``."""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "peers"))

from measurement import now, report, window

from thorndike import startup

if __name__ == "__main__":
    # What is set here is read when JAX is imported.
    startup.prepare()
    startup.prepare_large_steps()
    import jax

    from thorndike.language.generation import generate
    from thorndike.language.model import load_decoder

    parser = argparse.ArgumentParser()
    for name in ("--batch", "--prompt", "--new", "--rounds"):
        parser.add_argument(name, type=int, required=True)
    parser.add_argument("folder")
    options = parser.parse_args()
    config, params = load_decoder(options.folder)
    key = jax.random.key(0)
    prompts = jax.random.randint(key, (options.batch, options.prompt), 3, config.vocab_size)
    segments = prompts * 0 + 1

    def run(number: int) -> None:
        found = generate(
            params, config, prompts, segments, jax.random.fold_in(key, number), max_new_tokens=options.new, stop_tokens=()
        )  # fmt: skip
        if int(found.lengths.min()) != options.new:
            raise SystemExit(f"{found.lengths}")

    start = now()
    run(0)
    compiled = window(start, now())
    start = now()
    for number in range(options.rounds):
        run(1 + number)
    report(name="Thorndike", compile_cpu_s=compiled["cpu_s"], **window(start, now(options.batch * options.new * options.rounds)))
