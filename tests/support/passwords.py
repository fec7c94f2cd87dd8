"""Passwords of test users with their hashes, derived once and for all.

They are the weakest that are taken: a login takes half the time of one with a hash that
PasswordHash.of() makes.
"""

PASSWORD = "correct horse"
HASH = "scrypt$16384$8$1$AAECAwQFBgcICQoLDA0ODw==$JbN2hANm9NOw4h5BRHZnbjzQ6Jr0QwNWojTOC2WgIbU="
SECRET_HASH = (
    "scrypt$16384$8$1$AAECAwQFBgcICQoLDA0ODw==$lUTkiXnaPIlt+39/W8AV+zIOgQ+DcviNZtmSHaWiqmU="
)
"""Hash of the password ``secret``, which pages of the docs use."""
