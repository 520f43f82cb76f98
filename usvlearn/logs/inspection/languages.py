"""Words of a boat's logs in European languages of the Latin script, beside the English ones of `vocabulary`.

Danish, Dutch, Finnish, French, German, Italian, Norwegian, Polish, Portuguese, Spanish and Swedish. They are compared
without accents; ä, ö and ü also as ae, oe and ue.
"""

from __future__ import annotations

import unicodedata

UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue"})
LETTERS = str.maketrans({"ß": "ss", "æ": "ae", "ø": "o", "œ": "oe", "ł": "l", "đ": "d",  # without a decomposition
                         "δ": "delta", "ψ": "psi", "χ": "chi", "τ": "tau", "ω": "omega"})  # fmt: skip


def plain(text: str) -> str:
    """Lower case in ASCII: umlauts with an e, other letters without their accents."""
    return bare(unicodedata.normalize("NFC", text).lower().translate(UMLAUTS))


def bare(text: str) -> str:
    """The same without an e for an umlaut."""
    lower = unicodedata.normalize("NFC", text).lower().translate(LETTERS)
    return unicodedata.normalize("NFKD", lower).encode("ascii", "ignore").decode()


def spelled(text: str) -> set[str]:
    """Words in both spellings."""
    return {each for word in text.split() for each in (plain(word), bare(word))}


LEFT = spelled(
    "links linke linker backbord gauche bâbord izquierda izquierdo babor sinistra sinistro babordo esquerda esquerdo "
    "bombordo bakboord vänster venstre bagbord lewa lewy lewo bakburta vasen paapuuri"
)
RIGHT = spelled(
    "rechts rechte rechter steuerbord droite tribord derecha derecho estribor destra destro dritta tribordo direita "
    "direito estibordo boreste stuurboord höger høyre højre styrbord prawa prawy prawo sterburta oikea tyyrpuuri"
)
SHORT_LEFT, SHORT_RIGHT = {"sx", "izq", "esq"}, {"dx", "dcha"}  # beside the word of a drive only
GEARS = spelled(
    "gang getriebe richtung rückwärts vorwärts marche sens arrière inverseur marcha atrás retromarcia marcia "
    "sentido inversor ré keerkoppeling achteruit richting versnelling backslag växel gear bakk bak bieg wstecz vaihde"
)
SETPOINT = spelled(
    "soll sollwert consigne consigna deseado desejado desiderato gewenst önskad ønsket børværdi börvärde zadana tavoite"
)
LATERAL = spelled("bug heck étrave poupe prua poppa proa popa boeg hek baug bugstrahlruder heckstrahlruder boegschroef")
FOREIGN = spelled(
    "strom spannung tiefe temperatur akku luft vent viento vento vind wiatr tuuli batterie bateria batteria batteri "
    "accu courant corriente corrente ström strøm tension tensión tensione spanning profondeur profundidad profondità "
    "profundidade diepte djup dybde roulis tangage rollio beccheggio balanceo cabeceo rullning stampning"
    " windgeschwindigkeit windsnelheid vindhastighet vindhastighed vindstyrke"
)
TURNS = spelled("gier gieren dreh lacet guiñada guinada imbardata gir")
RATES = spelled(
    "geschwindigkeit vitesse taux velocidad velocità velocidade hastighet hastighed snelheid nopeus prędkość"
)
OVER_GROUND = spelled("grund fond fondo grond fundo")
DRIVES = spelled(
    "drehzahl schub poussée empuje spinta empuxo stuwkracht skyvekraft ciąg hélice elica schroef potkuri śruba skrue"
)
ROLES: dict[str, dict[float, str]] = {  # role -> how strongly -> words
    "heading": {3: "steuerkurs gierwinkel lacet guiñada guinada imbardata prua", 2: "kurs koers rumbo rumo proa kurssi "
                "ausrichtung cap", 1: "richtung azimut retning suunta"},
    "course": {3: "kog grondkoers", 2: "rotta derrota", 1.5: "grund fond grond fondo fundo route", 1: "kurs koers"},
    "yaw_rate": {3: "gierrate giergeschwindigkeit drehrate drehgeschwindigkeit wendegeschwindigkeit giersnelheid "
                 "draaisnelheid girhastighet girhastighed svinghastighet drejehastighed"},
    "surge": {2.5: "geschwindigkeit fahrt vitesse velocidad velocità velocidade hastighet hastighed fart snelheid "
              "vaart nopeus vauhti prędkość", 1.5: "tempo"},
    "sway": {3: "seitengeschwindigkeit quergeschwindigkeit querfahrt dwarssnelheid sidofart sidehastighet "
                "sidehastighed sivuttaisnopeus",
             2: "seitlich seitliche quer latéral latérale laterale zijwaarts zijwaartse dwars sidledes sideveis "
                "sidelæns sivuttainen boczna poprzeczna"},
    "latitude": {3: "breite breitengrad latitud latitudine breedte breedtegraad breddgrad breddegrad szerokość leveys "
                 "leveysaste"},
    "longitude": {3: "länge längengrad longitud longitudine lengte lengtegraad längdgrad lengdegrad længdegrad długość "
                  "pituus pituusaste"},
    "north": {3: "nordwert", 2: "nord noord norr norte"},
    "east": {3: "ostwert", 2: "ost oost øst öster este leste"},
    "command": {3: "schub poussée empuje spinta empuxo stuwkracht skyvekraft", 2.5: "moteur motore moottori silnik "
                "propulseur propulsor propulsore", 2: "antrieb maschine motoren motorer hélice elica schroef potkuri "
                "śruba skrue commande comando mando aandrijving pådrag", 1.8: "drehzahl régime toerental varvtal "
                "turtall omdrejninger giri obroty kierrosluku", 1.5: "gas gaz leistung puissance vermogen"},
    "rudder": {3: "ruder ruderlage gouvernail safran timón timone leme roer roder ror peräsin", 2: "barre ster"},
}  # fmt: skip
SIDEWAYS = {word for text in ROLES["sway"].values() for word in spelled(text)}


def weights(role: str) -> dict[str, float]:
    """The words of a role, with how strongly they name it."""
    return {word: weight for weight, text in ROLES.get(role, {}).items() for word in spelled(text)}
