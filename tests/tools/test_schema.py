from __future__ import annotations

from tools import schema


def test_published_schema_is_that_of_the_structs(capsys):
    assert schema.main(["--check"]) == 0
    assert capsys.readouterr().out == ""


def test_check_refuses_another_schema(monkeypatch, tmp_path, capsys):
    old = tmp_path / "plant.schema.json"
    old.write_text(schema.render().replace('"cycle_us"', '"cycle_ms"', 1))
    monkeypatch.setattr(schema, "_ROOT", tmp_path)
    monkeypatch.setattr(schema, "FILE", old)
    assert schema.main(["--check"]) == 1
    assert "python -m tools.schema" in capsys.readouterr().out
    assert schema.main([]) == schema.main(["--check"]) == 0
