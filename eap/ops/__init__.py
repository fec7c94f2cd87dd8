"""What commands do with running stations and buses, with files, and with captured frames."""
