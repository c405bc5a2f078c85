"""Writes ``tests/language/reference``: tiny models as transformers saves them, with its logits, its greedy texts and its chats.

Needs transformers, torch and peft: ``python tests/language/make_reference.py``. The default tests compare with these files, so that they
need none of the three; ``test_transformers_live.py`` makes the same models anew where transformers is installed.
"""

import json
import shutil
from pathlib import Path

REFERENCE = Path(__file__).parent / "reference"
SMALL = {"vocab_size": 96, "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4}
SMALL |= {"num_key_value_heads": 2, "max_position_embeddings": 128, "bos_token_id": 1, "eos_token_id": None, "pad_token_id": 0}
LLAMA3 = {"rope_type": "llama3", "factor": 8.0, "low_freq_factor": 1.0, "high_freq_factor": 4.0, "original_max_position_embeddings": 32}
CASES = {
    "gpt2": ("GPT2", {"vocab_size": 96, "n_embd": 32, "n_layer": 2, "n_head": 4, "n_positions": 128, "n_inner": 48}),
    "llama": ("Llama", SMALL | {"head_dim": 12, "rope_parameters": {"rope_type": "default", "rope_theta": 2e3}}),
    "llama3": (
        "Llama",
        SMALL | {"rope_parameters": LLAMA3 | {"rope_theta": 5e5}, "tie_word_embeddings": True, "attention_bias": True, "mlp_bias": True},
    ),
    "llama_linear": ("Llama", SMALL | {"rope_parameters": {"rope_type": "linear", "factor": 4.0, "rope_theta": 3e3}}),
    "llama_dynamic": ("Llama", SMALL | {"rope_parameters": {"rope_type": "dynamic", "factor": 2.0, "rope_theta": 3e3}}),
    "mistral": ("Mistral", SMALL | {"sliding_window": 7, "head_dim": 12, "rope_parameters": {"rope_type": "default", "rope_theta": 7e4}}),
    "qwen2": (
        "Qwen2",
        SMALL
        | {"rope_parameters": {"rope_type": "default", "rope_theta": 1e6}, "tie_word_embeddings": True}
        | {"use_sliding_window": True, "sliding_window": 6, "max_window_layers": 1},
    ),
    "qwen3": ("Qwen3", SMALL | {"head_dim": 16, "rope_parameters": {"rope_type": "default", "rope_theta": 5e6}}),
    "gemma2": (
        "Gemma2",
        SMALL
        | {"head_dim": 12, "query_pre_attn_scalar": 20, "sliding_window": 6, "attn_logit_softcapping": 3.0, "final_logit_softcapping": 1.5}
        | {"rope_parameters": {"rope_type": "default", "rope_theta": 3e3}},
    ),
    "gemma3": (
        "Gemma3",
        SMALL
        | {"num_hidden_layers": 3, "head_dim": 12, "query_pre_attn_scalar": 20, "sliding_window": 6, "sliding_window_pattern": 3}
        | {
            "rope_parameters": {
                "full_attention": {"rope_type": "linear", "factor": 2.0, "rope_theta": 4e5},
                "sliding_attention": {"rope_type": "default", "rope_theta": 3e3},
            }
        },
    ),
    "phi3": (
        "Phi3",
        SMALL | {"sliding_window": 9, "rope_parameters": {"rope_type": "default", "rope_theta": 2e4, "partial_rotary_factor": 0.5}},
    ),
    "phi3_longrope": (
        "Phi3",
        SMALL
        | {"max_position_embeddings": 512, "original_max_position_embeddings": 128}
        | {
            "rope_parameters": {
                "rope_type": "longrope",
                "rope_theta": 2e4,
                "short_factor": [1.0, 1.1, 1.3, 1.6],
                "long_factor": [1.0, 2.0, 3.0, 4.0],
            }
        },
    ),
}
"""Name -> transformers' class, and its settings: nothing at its default that a wrong decoder would get right."""
SHARDED = "llama3"
LENGTHS, WIDTH, GREEDY = (20, 17, 9), 20, 64
SCORED = ("gpt2", "llama", "gemma3")
LORA = {"llama": ["q_proj", "v_proj", "down_proj"], "gpt2": ["c_attn", "c_proj"], "phi3": ["qkv_proj", "o_proj"]}

CHATML = (
    "{% for message in messages %}{{ '<|im_start|>' + message['role'] + '\\n' + message['content'] + '<|im_end|>' + '\\n' }}"
    "{% endfor %}{% if add_generation_prompt %}{{ '<|im_start|>assistant\\n' }}{% endif %}"
)
CHATS = {
    "chatml": CHATML,
    "blocks": """{{- bos_token }}
{%- set state = namespace(system='') %}
{%- for message in messages %}
    {%- if message.role == 'system' %}
        {%- set state.system = message.content | trim %}
        {%- continue %}
    {%- endif %}
    {{- '[' + message.role | upper + '] ' }}
    {%- if loop.index0 == 1 and state.system %}
        {{- '(' + state.system + ') ' }}
    {%- endif %}
    {{- message['content'] | trim + '\\n' }}
{%- endfor %}
{%- if add_generation_prompt %}
    {{- '[ASSISTANT] ' }}
{%- endif %}
""",
    "json": "{{ messages | tojson }} {{ messages | tojson(indent=2) }} {{ {'<é>': 1} | tojson }}",
    "generation": "{% for m in messages %}{% if m.role == 'assistant' %}{% generation %}{{ m.content }}{{ eos_token }}{% endgeneration %}"
    "{% else %}<{{ m.role }}>{{ m.content }}{% endif %}{% endfor %}",
    "instruct": "{% for m in messages if m.role != 'system' %}{% if (m.role == 'user') != (loop.index0 % 2 == 0) %}"
    "{{ raise_exception('user and assistant must take turns') }}{% endif %}"
    "{% if m.role == 'user' %}{{ bos_token + '[INST] ' + m.content + ' [/INST]' }}{% else %}{{ ' ' + m.content + eos_token }}{% endif %}"
    "\n{% endfor %}\n",
}
MESSAGES = [
    {"role": "system", "content": " Be brief. "},
    {"role": "user", "content": "Is <this> \"good\" & 'true'?\n"},
    {"role": "assistant", "content": "Yes: café ✓."},
    {"role": "user", "content": "Why?"},
]


def main() -> None:
    shutil.rmtree(REFERENCE, ignore_errors=True)
    for name in CASES:
        write_case(name)
    for name in SCORED:
        write_scored(name)
    for name in LORA:
        write_adapter(name)
    write_chats()
    import peft
    import torch
    import transformers

    versions = {"transformers": transformers.__version__, "torch": torch.__version__, "peft": peft.__version__}
    (REFERENCE / "versions.json").write_text(json.dumps(versions, indent=2) + "\n")


def make_model(name: str, kind: str = "ForCausalLM", **changes):
    """A random model of a case, its norms and biases far from where they begin."""
    import torch
    import transformers

    family, settings = CASES[name]
    torch.manual_seed(sum(map(ord, name)))
    text_config = "Gemma3Text" if family == "Gemma3" else family
    config = getattr(transformers, text_config + "Config")(**settings | changes, attn_implementation="eager")
    if family == "GPT2":
        config.eos_token_id, config.pad_token_id = None, 0
    head = "LMHeadModel" if family == "GPT2" and kind == "ForCausalLM" else kind
    model = getattr(transformers, (text_config if "Sequence" in kind else family) + head)(config).eval()
    with torch.no_grad():
        for key, parameter in model.named_parameters():
            if parameter.ndim == 1:
                parameter.add_(0.3 * torch.randn_like(parameter))
            else:
                parameter.copy_(_spread(key, model.config) * torch.randn_like(parameter))
    return model


def _spread(name: str, config) -> float:
    """The deviation of a matrix. A tied embedding is small, or every text would repeat its last token."""
    if "embed" not in name and "wte" not in name:
        return 0.25
    return 1.0 if not config.tie_word_embeddings else 0.06 if config.model_type.startswith("gemma") else 0.1


def inputs():
    """Left-padded tokens, their mask and positions."""
    import torch

    torch.manual_seed(0)
    tokens, mask = torch.randint(3, 96, (len(LENGTHS), WIDTH)), torch.zeros((len(LENGTHS), WIDTH), dtype=torch.long)
    for row, length in enumerate(LENGTHS):
        mask[row, WIDTH - length :] = 1
    return tokens * mask, mask, (mask.cumsum(-1) - 1).clamp(min=0)


def answers(model):
    """Its logits where there is text, and the 64 tokens it goes on with."""
    import torch

    tokens, mask, positions = inputs()
    with torch.no_grad():
        found = model(input_ids=tokens, attention_mask=mask, position_ids=positions).logits.float()
        texts = model.generate(input_ids=tokens, attention_mask=mask, max_new_tokens=GREEDY, do_sample=False, pad_token_id=0)
    return {"tokens": tokens, "mask": mask, "logits": found * mask[..., None], "greedy": texts[:, WIDTH:].contiguous()}


def save(folder: Path, model, arrays, shard: str = "5GB") -> None:
    from safetensors.torch import save_file

    model.save_pretrained(folder, max_shard_size=shard)
    save_file(arrays, folder / "expected.safetensors")


def write_case(name: str) -> None:
    model = make_model(name)
    save(REFERENCE / name, model, answers(model), "60KB" if name == SHARDED else "5GB")


def scores(model):
    """Its score of each text, as transformers takes it: at the last token that is no padding."""
    import torch

    tokens, mask, positions = inputs()
    with torch.no_grad():
        return model(input_ids=tokens, attention_mask=mask, position_ids=positions).logits.float()[:, 0]


def write_scored(name: str) -> None:
    model = make_model(name, "ForSequenceClassification", num_labels=1)
    save(REFERENCE / f"{name}_scored", model, {"scores": scores(model)})


def make_adapter(name: str):
    """The case's model with a LoRA adapter that does something."""
    import peft
    import torch

    settings = peft.LoraConfig(r=3, lora_alpha=7, target_modules=LORA[name], task_type="CAUSAL_LM", fan_in_fan_out=name == "gpt2")
    adapted = peft.get_peft_model(make_model(name), settings)
    with torch.no_grad():
        for key, parameter in adapted.named_parameters():
            if "lora_" in key:
                parameter.copy_(0.3 * torch.randn_like(parameter))
    return adapted.eval()


def write_adapter(name: str) -> None:
    from safetensors.torch import save_file

    adapted = make_adapter(name)
    folder = REFERENCE / f"{name}_lora"
    adapted.save_pretrained(folder)
    (folder / "README.md").unlink(missing_ok=True)
    arrays = answers(adapted)
    save_file({"logits": arrays["logits"]}, folder / "expected.safetensors")


def make_tokenizer(template: str | None = None):
    """A small byte-level tokenizer whose end is not its padding."""
    import tokenizers
    import transformers

    inner = tokenizers.Tokenizer(tokenizers.models.BPE())
    inner.pre_tokenizer = tokenizers.pre_tokenizers.ByteLevel(add_prefix_space=False)
    inner.decoder = tokenizers.decoders.ByteLevel()
    special = ["<pad>", "<s>", "</s>", "<|im_start|>", "<|im_end|>"]
    trainer = tokenizers.trainers.BpeTrainer(
        vocab_size=300, special_tokens=special, initial_alphabet=tokenizers.pre_tokenizers.ByteLevel.alphabet(), show_progress=False
    )
    inner.train_from_iterator(["the film was good and the film was bad", "why is this film so good"] * 5, trainer)
    made = transformers.PreTrainedTokenizerFast(tokenizer_object=inner, bos_token="<s>", eos_token="</s>", pad_token="<pad>")
    made.chat_template = template
    return made


def chat_texts(tokenizer) -> dict[str, str]:
    return {name: tokenizer.apply_chat_template(MESSAGES, chat_template=text, tokenize=False) for name, text in CHATS.items()} | {
        f"{name}_prompt": tokenizer.apply_chat_template(MESSAGES, chat_template=text, tokenize=False, add_generation_prompt=True)
        for name, text in CHATS.items()
    }


def write_chats() -> None:
    tokenizer = make_tokenizer(CHATML)
    folder = REFERENCE / "tokenizer"
    tokenizer.save_pretrained(folder)
    texts = ["the film was good", "Why ✓ café?\n", "<s>a</s>b", ""]
    found = {"chats": chat_texts(tokenizer), "texts": texts, "ids": [tokenizer(text)["input_ids"] for text in texts]}
    found["decoded"] = [tokenizer.decode(ids, skip_special_tokens=True) for ids in found["ids"]]
    (folder / "expected.json").write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
