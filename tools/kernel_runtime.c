/* Functions of numba's runtime that compiled kernels call: the memory of arrays that they make, and reshape.

   As in numba/core/runtime/nrt.h and numba/_helperlib.c, for one thread or many, without Python. */

#include <stddef.h>
#include <stdlib.h>

/* Numba's compiled code counts `references` and reads `data` itself. */
typedef struct {
    size_t references;
    void *destructor, *destructor_argument;
    void *data;
    size_t size;
} Block;

/* A block for `size` bytes at a multiple of `align`, a power of two; NULL when memory runs out. */
__attribute__((visibility("hidden"))) Block *NRT_MemInfo_alloc_aligned(size_t size, unsigned align)
{
    Block *block;
    size_t spare = align > 64 ? align : 64;
    if (size > (size_t)-1 - sizeof *block - spare || !(block = malloc(sizeof *block + spare + size)))
        return NULL;
    block->references = 1;
    block->destructor = block->destructor_argument = NULL;
    block->data = (void *)(((size_t)(block + 1) + spare - 1) & ~(spare - 1));
    block->size = size;
    return block;
}

/* Free a block without references. */
__attribute__((visibility("hidden"))) void NRT_MemInfo_call_dtor(Block *block)
{
    free(block);
}

/* Strides of an array without gaps in another shape; 0 for any other array, which numba does not compile either. */
__attribute__((visibility("hidden"))) int numba_attempt_nocopy_reshape(
    ptrdiff_t old_rank, const ptrdiff_t *old_shape, const ptrdiff_t *old_strides,
    ptrdiff_t rank, const ptrdiff_t *shape, ptrdiff_t *strides, ptrdiff_t item, int columns_first)
{
    ptrdiff_t step = item;
    int gaps = 0;
    for (ptrdiff_t k = old_rank - 1; k >= 0; step *= old_shape[k--])
        gaps |= old_shape[k] != 1 && old_strides[k] != step;
    if (columns_first || (gaps && step != 0))
        return 0;
    step = item;
    for (ptrdiff_t k = rank - 1; k >= 0; step *= shape[k--])
        strides[k] = step;
    return 1;
}

/* Drop a reference that a kernel returned. */
__attribute__((visibility("default"))) void polsep_release(Block *block)
{
    if (__atomic_sub_fetch(&block->references, 1, __ATOMIC_ACQ_REL) == 0)
        free(block);
}

/* The name by which the table knows this library. */
__attribute__((visibility("default"))) const char polsep_stamp[] = STAMP;

/* These got new versions when glibc 2.29 and 2.35 stopped to set errno as before; older systems know only the first. */
__asm__(".symver first_exp, exp@GLIBC_2.2.5");
__asm__(".symver first_hypot, hypot@GLIBC_2.2.5");
double first_exp(double x);
double first_hypot(double x, double y);

__attribute__((visibility("hidden"))) double __wrap_exp(double x)
{
    return first_exp(x);
}

__attribute__((visibility("hidden"))) double __wrap_hypot(double x, double y)
{
    return first_hypot(x, y);
}
