"""What ``check-env`` looks at, one subject a file. Free of JAX."""
