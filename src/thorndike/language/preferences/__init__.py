"""What people prefer: a store of judgements, who is asked what, how far raters agree, and what to believe when they do not."""
