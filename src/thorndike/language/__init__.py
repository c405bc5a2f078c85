"""Language models: reading and writing them as Hugging Face folders, generating text, and learning from text, labels and preferences."""
