"""transformers' ``generate`` on a folder's model: tokens per second and per CPU-second; a line for ``language_speed.py``."""

import argparse

import torch
from measurement import now, report, window
from transformers import AutoModelForCausalLM

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for name in ("--batch", "--prompt", "--new", "--rounds"):
        parser.add_argument(name, type=int, required=True)
    parser.add_argument("folder")
    options = parser.parse_args()
    torch.manual_seed(0)
    model = AutoModelForCausalLM.from_pretrained(options.folder, dtype=torch.float32).eval()
    prompts = torch.randint(3, model.config.vocab_size, (options.batch, options.prompt))
    mask = torch.ones_like(prompts)

    def run() -> None:
        with torch.no_grad():
            found = model.generate(
                input_ids=prompts, attention_mask=mask, do_sample=True, temperature=1.0, top_k=0, top_p=1.0,
                max_new_tokens=options.new, min_new_tokens=options.new, pad_token_id=0,
            )  # fmt: skip
        if found.shape[1] != options.prompt + options.new:
            raise SystemExit(f"{found.shape}")

    run()
    start = now()
    for _ in range(options.rounds):
        run()
    report(name="transformers", **window(start, now(options.batch * options.new * options.rounds)))
