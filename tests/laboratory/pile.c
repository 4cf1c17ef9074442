// The pile of discs, written by hand in C: the speed of the machine without a framework.
//
// Verlet in displacement form, cells by counting sort, a neighbour list with a skin (particles stored in cell order), one Jacobi
// pass of contacts with relaxation 0.6, a box. The same lattice, box, gravity and steps as the report's own pile; it has neither
// an error bound nor fixed bits, lists at most 12 neighbours of a disc, and its contacts are softer.
//
//     gcc -O3 -march=native -ffast-math -fopenmp pile.c -lm -o pile
//     OMP_NUM_THREADS=2 ./pile 100000 8        # discs, substeps of a frame of 1/60 s; then commands, one a line:
//                                              # "restart"; "run 60": so many frames, prints the seconds; "quality"
#include <math.h>
#include <omp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NEAR 12

typedef struct {
    float x, y;
} Vec;

static const float R = 0.5f, SKIN = 0.1f, CELL = 1.1f, SPACING = 1.1f, RELAX = 0.6f;
static int n, side, columns, cells;
static float width, height;
static Vec *x, *d, *origin, *move, *x_sorted, *d_sorted;
static int *begin, *slot, *cell, *number, *near;

// Pseudorandom numbers in [0, 1): the last steps of MurmurHash3. An even sequence would make branches too predictable.
static float scattered(uint32_t k) {
    k = (k ^ k >> 16) * 0x85ebca6bu;
    k = (k ^ k >> 13) * 0xc2b2ae35u;
    return (k ^ k >> 16) / 4294967296.0;
}

static void restart(void) {
    for (int i = 0; i < n; i++) {
        x[i].x = (i % side) * SPACING + R + 0.05f * scattered(2 * i + 1);
        x[i].y = (i / side) * SPACING + R + 0.05f * scattered(2 * i + 2);
        origin[i] = (Vec){1e9f, 1e9f};
        d[i] = (Vec){0, 0};
    }
}

static inline float inside(float a, float most) { return fminf(fmaxf(a, R), most - R); }

// Integrate and confine to the box. Returns whether a disc has moved by half the skin since the list was built.
static int integrate(float fall) {
    const float w = width, h = height;
    Vec *restrict X = x, *restrict D = d, *restrict O = origin;
    int moved = 0;
#pragma omp parallel for reduction(| : moved) schedule(static)
    for (int i = 0; i < n; i++) {
        float dx = D[i].x, dy = D[i].y + fall, px = X[i].x + dx, py = X[i].y + dy;
        float qx = inside(px, w), qy = inside(py, h);
        D[i] = (Vec){dx + qx - px, dy + qy - py};
        X[i] = (Vec){qx, qy};
        float ex = qx - O[i].x, ey = qy - O[i].y;
        moved |= ex * ex + ey * ey > 0.25f * SKIN * SKIN;
    }
    return moved;
}

// Sort the discs into cells, and list the neighbours of each.
static void build(void) {
    memset(begin, 0, (cells + 1) * sizeof(int));
#pragma omp parallel for schedule(static)
    for (int i = 0; i < n; i++) cell[i] = (int)(x[i].y / CELL) * columns + (int)(x[i].x / CELL);
    for (int i = 0; i < n; i++) begin[cell[i] + 1]++;
    for (int k = 0; k < cells; k++) begin[k + 1] += begin[k];
    memcpy(slot, begin, (cells + 1) * sizeof(int));
    for (int i = 0; i < n; i++) {
        int k = slot[cell[i]]++;
        x_sorted[k] = x[i];
        d_sorted[k] = d[i];
    }
    const int rows = cells / columns;
#pragma omp parallel for schedule(static)
    for (int i = 0; i < n; i++) {
        Vec p = x_sorted[i];
        x[i] = origin[i] = p;
        d[i] = d_sorted[i];
        int a = p.x / CELL, b = p.y / CELL, count = 0;
        int left = a > 0 ? a - 1 : 0, right = a + 1 < columns ? a + 1 : columns - 1;
        for (int row = b > 0 ? b - 1 : 0; row <= b + 1 && row < rows; row++)
            for (int j = begin[row * columns + left]; j < begin[row * columns + right + 1]; j++) {
                float ex = p.x - x_sorted[j].x, ey = p.y - x_sorted[j].y;
                if (j != i && ex * ex + ey * ey < CELL * CELL && count < NEAR) near[(size_t)i * NEAR + count++] = j;
            }
        number[i] = count;
    }
}

// One Jacobi pass: sum the contact corrections of each disc, then apply all of them.
static void collide(void) {
    const float w = width, h = height;
    Vec *restrict M = move;
    const Vec *restrict P = x;
    const int *restrict N = near, *restrict C = number;
#pragma omp parallel for schedule(static)
    for (int i = 0; i < n; i++) {
        Vec p = P[i];
        float mx = 0, my = 0;
        for (int k = 0; k < C[i]; k++) {
            Vec q = P[N[(size_t)i * NEAR + k]];
            float ex = p.x - q.x, ey = p.y - q.y, square = ex * ex + ey * ey;
            if (square < 4 * R * R) {
                float length = sqrtf(square), share = 0.5f * (2 * R - length) / (length + 1e-9f);
                mx += ex * share;
                my += ey * share;
            }
        }
        M[i] = (Vec){RELAX * mx, RELAX * my};
    }
    Vec *restrict X = x, *restrict D = d;
#pragma omp parallel for schedule(static)
    for (int i = 0; i < n; i++) {
        float px = X[i].x + M[i].x, py = X[i].y + M[i].y, qx = inside(px, w), qy = inside(py, h);
        D[i].x += M[i].x + qx - px;
        D[i].y += M[i].y + qy - py;
        X[i] = (Vec){qx, qy};
    }
}

// The mean overlap of the pairs that overlap, in diameters.
static double overlap(void) {
    double sum = 0, pairs = 0;
    build();
    for (int i = 0; i < n; i++)
        for (int k = 0; k < number[i]; k++) {
            Vec q = x[near[(size_t)i * NEAR + k]];
            double depth = 1 - hypot(x[i].x - q.x, x[i].y - q.y) / (2 * R);
            sum += depth > 0 ? depth : 0;
            pairs += depth > 0;
        }
    return pairs ? sum / pairs : 0;
}

int main(int count, char **words) {
    if (count != 3) return 2;
    n = atoi(words[1]);
    int substeps = atoi(words[2]), frames;
    side = ceil(sqrt(n));
    width = side * 1.3f;
    height = side * 2.0f;
    columns = ceil(width / CELL) + 1;
    cells = columns * (int)(ceil(height / CELL) + 1);
    x = malloc(n * sizeof(Vec)), d = malloc(n * sizeof(Vec)), origin = malloc(n * sizeof(Vec)), move = malloc(n * sizeof(Vec));
    x_sorted = malloc(n * sizeof(Vec)), d_sorted = malloc(n * sizeof(Vec));
    begin = malloc((cells + 1) * sizeof(int)), slot = malloc((cells + 1) * sizeof(int));
    cell = malloc(n * sizeof(int)), number = malloc(n * sizeof(int)), near = malloc((size_t)n * NEAR * sizeof(int));
    float h = 1 / 60.f / substeps, fall = -9.81f * h * h;
    char line[64];
    restart();
    while (fgets(line, sizeof line, stdin)) {
        if (sscanf(line, "run %d", &frames) == 1) {
            double clock = omp_get_wtime();
            for (int s = 0; s < frames * substeps; s++) {
                if (integrate(fall)) build();
                collide();
            }
            printf("%.9f\n", omp_get_wtime() - clock);
        } else if (!strncmp(line, "quality", 7)) {
            printf("{\"overlap\": %.9g, \"residual\": 0}\n", overlap());
        } else {
            restart();
            printf("0\n");
        }
        fflush(stdout);
    }
    return 0;
}
