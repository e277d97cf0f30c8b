"""``python -m torchptz.cli``, where no script of that name was installed."""

from torchptz.cli.commands import main

main()
